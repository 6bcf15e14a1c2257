"""What a forked child needs to compute: threads of its own. Of its parent's threads none lives in it."""

from __future__ import annotations

import functools
import os
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, TypeVar

import torch

Argument = TypeVar("Argument")
Result = TypeVar("Result")

_FIRST_PROCESS = os.getpid()


def prepare_for_forks() -> None:
    """Let torch compute with one thread in children that this process forks from now on, and in this one if it is such a child.

    Torch's pool of threads is gone in a forked child, which would wait for it for ever at its first large operation. Simulators and
    transport solvers call this when they are made. A child may choose another number of threads afterwards.
    """
    _register(os.getpid())


@functools.lru_cache(maxsize=1)
def _register(process: int) -> None:
    """Once in each process that asks; a child inherits what its parent registered, and a second time does no harm."""
    if process != _FIRST_PROCESS:
        _use_one_thread()
    if hasattr(os, "register_at_fork"):
        os.register_at_fork(after_in_child=_use_one_thread)


def _use_one_thread() -> None:
    torch.set_num_threads(1)


class LocalThreads:
    """A pool of threads that each process starts for itself, when it first needs it.

    Args:
        threads: Size of the pool.
    """

    def __init__(self, threads: int) -> None:
        self._threads = threads
        self._pools: dict[int, ThreadPoolExecutor] = {}
        self._lock = threading.Lock()
        self._process = os.getpid()

    def submit(self, work: Callable[..., Result], *arguments: Any) -> Future[Result]:
        """Start work on one of the threads; see `concurrent.futures.Executor.submit`."""
        return self._pool().submit(work, *arguments)

    def map(self, work: Callable[[Argument], Result], arguments: Iterable[Argument]) -> Iterator[Result]:
        """Do the work for every argument; see `concurrent.futures.Executor.map`."""
        return self._pool().map(work, arguments)

    def _pool(self) -> ThreadPoolExecutor:
        process = os.getpid()
        if process != self._process:
            # a lock that another thread held at the fork is never released here
            self._lock, self._process = threading.Lock(), process
        with self._lock:
            if process not in self._pools:
                self._pools = {process: ThreadPoolExecutor(self._threads)}
            return self._pools[process]
