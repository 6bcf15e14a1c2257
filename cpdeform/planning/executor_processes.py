"""The executor that spreads batches over processes of this machine."""

from __future__ import annotations

import contextlib
import functools
import multiprocessing
import os
import pickle
import signal
import tempfile
import uuid
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from types import TracebackType
from typing import Any, cast

from cpdeform.core.errors import EngineError, InputError
from cpdeform.core.machine import thread_environment
from cpdeform.planning.executor import Answer, Item

TRIES = 3
"""How often processes may die on the same items before that counts as an error."""


class ExecutorProcesses:
    """Computes items in processes, each with threads of its own; a context manager, at whose end they end.

    Simulators and objectives are sent to each process once and kept there. Processes that die are replaced, and their items
    computed again. A single item is computed in this process.

    Args:
        workers: Number of processes.
        threads: Threads of each.

    Raises:
        InputError: A number is below 1.
    """

    def __init__(self, workers: int, *, threads: int = 1) -> None:
        for name, number in (("workers", workers), ("threads", threads)):
            if number < 1:
                raise InputError(name, came=str(number), expected="at least 1")
        self.width, self.threads = workers, threads
        self._pool: ProcessPoolExecutor | None = None
        self._folder = tempfile.TemporaryDirectory(prefix="cpdeform-executor-")
        self._sent: tuple[object, Path] | None = None

    def map(self, function: Callable[[Item], Answer], items: Sequence[Item]) -> list[Answer]:
        """Answers in the order of the items; see `cpdeform.planning.executor.Executor.map`.

        Raises:
            InputError: The function, or what is in it, cannot be sent to another process.
            EngineError: Processes die again and again.
        """
        if len(items) < 2:
            return [function(item) for item in items]
        path, contents = self._send(function), [pack(item) for item in items]
        for _ in range(TRIES):
            # What a broken pool was at is lost, but no answer depends on what came before.
            with contextlib.suppress(BrokenProcessPool), self._environment():
                pool = self._pool = self._pool or self._start()
                return [cast(Answer, pickle.loads(answer)) for answer in pool.map(functools.partial(_compute, path), contents)]
            self._stop()
        raise EngineError(f"processes died {TRIES} times on the same candidates (out of memory, or killed). Use fewer workers.")

    def close(self) -> None:
        """End the processes."""
        self._stop()
        self._folder.cleanup()

    def __enter__(self) -> ExecutorProcesses:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    def _send(self, function: Callable[[Item], Answer]) -> str:
        """File with the function, for processes that do not have it yet."""
        if self._sent is None or self._sent[0] != function:
            path = Path(self._folder.name) / uuid.uuid4().hex
            path.write_bytes(pack(function))
            if self._sent is not None:
                self._sent[1].unlink(missing_ok=True)
            self._sent = (function, path)
        return str(self._sent[1])

    def _start(self) -> ProcessPoolExecutor:
        # Forked children would have none of the threads that compiled code keeps.
        context = multiprocessing.get_context("spawn")
        return ProcessPoolExecutor(self.width, mp_context=context, initializer=_ignore_interrupts)

    def _stop(self) -> None:
        if self._pool is not None:
            self._pool.shutdown(wait=True, cancel_futures=True)
            self._pool = None

    @contextlib.contextmanager
    def _environment(self) -> Iterator[None]:
        """The environment of processes that start now: libraries read the number of their threads when they are loaded."""
        wanted = thread_environment(self.threads)
        before = {name: os.environ.get(name) for name in wanted}
        os.environ.update(wanted)
        try:
            yield
        finally:
            for name, value in before.items():
                if value is None:
                    os.environ.pop(name, None)
                else:
                    os.environ[name] = value


def pack(content: object) -> bytes:
    """Pickle it here: torch's own way to other processes shares memory through files, of which there are few."""
    try:
        return pickle.dumps(content, protocol=pickle.HIGHEST_PROTOCOL)
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        raise InputError(
            "workers",
            came=f"a part that cannot be sent to another process ({error})",
            expected="parts that can be pickled",
            remedy="Leave workers out.",
        ) from error


@functools.lru_cache(maxsize=2)
def _function(path: str) -> Callable[[Any], Any]:
    function: Callable[[Any], Any] = pickle.loads(Path(path).read_bytes())
    return function


def _compute(path: str, content: bytes) -> bytes:
    return pickle.dumps(_function(path)(pickle.loads(content)), protocol=pickle.HIGHEST_PROTOCOL)


def _ignore_interrupts() -> None:
    """Control-C goes to all processes of a terminal; the one that plans decides what comes of it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
