"""Engines: where the workers of a sweep run. What comes of its jobs is the same on all of them."""

from __future__ import annotations

import abc
from collections.abc import Iterator

from cpdeform.core.errors import InputError
from cpdeform.sweep.queue import Queue
from cpdeform.sweep.worker import Outcome, WorkSettings


class Engine(abc.ABC):
    """Runs workers until a sweep is over.

    Args:
        workers: How many at the same time; None for as many as there is room for.

    Raises:
        InputError: `workers` is below 1.
    """

    def __init__(self, *, workers: int | None = None) -> None:
        if workers is not None and workers < 1:
            raise InputError("--workers", came=str(workers), expected="at least 1")
        self.workers = workers

    @abc.abstractmethod
    def work(self, queue: Queue, settings: WorkSettings) -> Iterator[Outcome]:
        """Do all jobs of a sweep.

        Args:
            queue: The sweep, in a directory that all workers see.
            settings: How to go about it.

        Returns:
            What came of each job, as soon as it is over. Jobs that others do at the same time need not be among them.

        Raises:
            EngineError: Workers cannot be started, or die without having begun.
        """
