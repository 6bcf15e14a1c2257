"""Child processes that tests interrupt."""

from __future__ import annotations

import contextlib
import signal
import sys
from collections.abc import Iterator, Sequence

COMMAND = (
    "import signal, sys\n"
    "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
    "from cpdeform.cli.main import main\n"
    "sys.argv[0] = 'cpdeform'\n"
    "main()\n"
)


def interruptible_command(arguments: Sequence[str]) -> list[str]:
    """The command line's arguments as a child's, which control-C interrupts even where its parent ignores it.

    What a script starts in the background ignores the signal, and children inherit that: Python then installs no handler.
    """
    return [sys.executable, "-c", COMMAND, *arguments]


@contextlib.contextmanager
def interrupts_ignored() -> Iterator[None]:
    """As if a script had started the tests in the background."""
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
