"""Interruptions of a command: control-C, a request to terminate, and the end of the terminal are all one `KeyboardInterrupt`.

Handlers belong to the process, so that only the command line installs them; the library just sees the exception.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from types import FrameType
from typing import Any

NAMES = ("SIGINT", "SIGTERM", "SIGHUP")
"""Signals that interrupt; not every system has all of them."""

BURST = 1.0
"""Seconds during which further signals count as the same interruption: who wants to stop presses the keys more than once."""

RETRY = 0.05
"""Seconds after which a signal comes again where Python had to ignore its exception."""


class Interruption(KeyboardInterrupt):
    """An interruption by a signal.

    Args:
        number: Number of the signal.
    """

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        self.number = number


def exit_code(error: KeyboardInterrupt) -> int:
    """The exit code that shells expect: 128 and the number of the signal; 130 for control-C."""
    cause = error if isinstance(error, Interruption) else error.__cause__
    return 128 + (cause.number if isinstance(cause, Interruption) else signal.SIGINT)


class _Handler:
    """Raises the first signal of a burst and ignores the others."""

    def __init__(self) -> None:
        self.last: float | None = None
        self._terminals = [number for number in (1, 2) if os.isatty(number)]

    def __call__(self, number: int, frame: FrameType | None) -> None:
        now = time.monotonic()
        if self.last is not None and now - self.last < BURST:
            return
        self.last = now
        if signal.Signals(number).name == "SIGHUP":
            self._leave_terminal()
        raise Interruption(number)

    def _leave_terminal(self) -> None:
        """Write to nowhere instead of to a terminal that is gone: else each line fails, as if that were the cause."""
        nowhere = os.open(os.devnull, os.O_WRONLY)
        for number in self._terminals:
            os.dup2(nowhere, number)
        os.close(nowhere)

    def unraisable(self, failed: sys.UnraisableHookArgs) -> None:
        """Let a signal come again whose exception fell into a destructor or callback, where Python ignores all exceptions."""
        if not isinstance(failed.exc_value, Interruption):
            sys.__unraisablehook__(failed)
            return
        self.last = None
        again = threading.Timer(RETRY, _raise_in_main_thread, (failed.exc_value.number,))
        again.daemon = True
        again.start()


def _raise_in_main_thread(number: int) -> None:
    """Send a signal to where its handler runs, so that a wait there ends."""
    main = threading.main_thread().ident
    if main is not None and hasattr(signal, "pthread_kill"):
        signal.pthread_kill(main, number)
    else:
        signal.raise_signal(number)


@contextlib.contextmanager
def interruptible() -> Iterator[None]:
    """Turn the signals into `Interruption` while the block runs.

    A signal that is ignored stays ignored, as for a command under ``nohup``. The handlers from before come back at the end, except
    after an interruption: the process is about to end then, and a second control-C should not cut that short.
    """
    if threading.current_thread() is not threading.main_thread():
        # Python runs handlers in the main thread alone.
        yield
        return
    handler = _Handler()
    before: dict[int, Any] = {}
    hook, sys.unraisablehook = sys.unraisablehook, handler.unraisable
    try:
        for number in (getattr(signal, name) for name in NAMES if hasattr(signal, name)):
            if signal.getsignal(number) is not signal.SIG_IGN:
                before[number] = signal.signal(number, handler)
        yield
    finally:
        sys.unraisablehook = hook
        for number, old in before.items():
            signal.signal(number, old if handler.last is None else signal.SIG_IGN)
