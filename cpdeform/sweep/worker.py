"""A worker: takes jobs from a sweep until none is left."""

from __future__ import annotations

import contextlib
import dataclasses
import datetime
import gc
import math
import os
import shutil
import sys
import time
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cpdeform.core.errors import CpdeformError, EngineError, InputError, brief
from cpdeform.core.machine import available_cores, thread_environment
from cpdeform.core.plugins import load_registry
from cpdeform.sweep.claim import STALE_AFTER, Claim, deaths, heartbeat, lose, silent, take
from cpdeform.sweep.job import Job, JobContext, JobFunction
from cpdeform.sweep.queue import ATTEMPTS, CLAIMS, DONE, FAILED, Queue, write_whole, writing_whole
from cpdeform.sweep.settle import settle

if TYPE_CHECKING:
    from cpdeform.planning.result import Observer

Observe = Callable[[Job], AbstractContextManager[Sequence["Observer"]]]
"""Gives the observers of a job, for as long as it goes on."""

ATTEMPTS_ALLOWED = 5
"""Workers that may die on a job before it counts as failed."""

FIRST_WAIT = 0.1
"""Seconds that a worker without a job waits before it looks again; each time twice as long."""

REASON_LENGTH = 500


@dataclasses.dataclass(frozen=True, kw_only=True)
class WorkSettings:
    """How workers go about a sweep; what comes of its jobs does not depend on it.

    Attributes:
        stale_after: Seconds without a heartbeat after which a worker counts as dead.
        attempts: Workers that may die on a job before it counts as failed.
        shard: Number of the part of the jobs that is to be done, from 0, and how many parts there are; None for all jobs.
        only: Names of the jobs that are to be done; None for all.

    Raises:
        InputError: A number is out of range.
    """

    stale_after: float = STALE_AFTER
    attempts: int = ATTEMPTS_ALLOWED
    shard: tuple[int, int] | None = None
    only: tuple[str, ...] | None = None

    def __post_init__(self) -> None:
        if not (math.isfinite(self.stale_after) and self.stale_after > 0):
            raise InputError("--stale-after", came=str(self.stale_after), expected="a number of seconds above 0")
        if self.attempts < 1:
            raise InputError("--attempts", came=str(self.attempts), expected="at least 1")
        if self.shard is not None and not 0 <= self.shard[0] < self.shard[1]:
            came = f"{self.shard[0]}/{self.shard[1]}"
            raise InputError("--shard", came=came, expected="i/n with i from 0 to n - 1, such as 0/4")

    def own(self, names: Sequence[str]) -> list[str]:
        """Of all names of a sweep, in order, those that are to be done."""
        wanted = list(names) if self.only is None else list(self.only)
        return wanted if self.shard is None else wanted[self.shard[0] :: self.shard[1]]

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> WorkSettings:
        """Settings as `dataclasses.asdict` gives them, after a way through JSON."""
        values: dict[str, Any] = {name: tuple(value) if isinstance(value, list) else value for name, value in content.items()}
        return cls(**values)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Outcome:
    """What came of a job.

    Attributes:
        name: Name of the job.
        outcome: ``"done"`` or ``"failed"``.
        figures: What its file says.
    """

    name: str
    outcome: str
    figures: dict[str, Any]


class _TakenError(Exception):
    """Another worker has the directory of an attempt."""


class Worker:
    """Does the jobs of a sweep, one after the other, in this process.

    Args:
        queue: The sweep.
        settings: How to go about it.
        identity: Name of this worker; defaults to a random one.
        function: Does a job; defaults to what the plugins register under the sweep's kind.
        observe: Gives observers of a job.
        own_process: Whether this process does nothing else.

    Attributes:
        ending: Whether this process has been told to end. A signal's handler sets it before it raises `SystemExit`; one that a job
            raises of its own accord is the job's failure.
    """

    def __init__(
        self,
        queue: Queue,
        settings: WorkSettings | None = None,
        *,
        identity: str | None = None,
        function: JobFunction | None = None,
        observe: Observe | None = None,
        own_process: bool = False,
    ) -> None:
        self.queue, self.settings = queue, settings or WorkSettings()
        self.identity = identity or uuid.uuid4().hex[:12]
        self._function: JobFunction = function or load_registry().load("job", queue.head.kind)
        self._observe = observe or _unobserved
        self._own_process = own_process
        self.ending = False
        self._names = self.settings.own(queue.names())
        self._left: Iterator[str] = iter(())
        if queue.head.threads is not None:
            limit_threads(queue.head.threads)

    def work(self) -> Iterator[Outcome]:
        """Do jobs until all are over, also those that other workers die on meanwhile.

        Returns:
            What came of each job that this worker did.
        """
        wait = FIRST_WAIT
        while True:
            claim = self._next()
            if claim is not None:
                wait = FIRST_WAIT
                outcome = self.do(claim)
                if outcome is not None:
                    yield outcome
            elif self._waiting():
                time.sleep(wait)
                wait = min(2.0 * wait, self.settings.stale_after / 5.0)
            else:
                return

    def do(self, claim: Claim) -> Outcome | None:
        """Do one job.

        Args:
            claim: This worker's claim to it, which ends with the job, however that ends.

        Returns:
            What came of it; None where another worker took it over, because this one had been silent for too long.
        """
        try:
            with heartbeat(claim, stale_after=self.settings.stale_after):
                return self._do(claim)
        finally:
            claim.release()

    def _do(self, claim: Claim) -> Outcome | None:
        begin, used = time.perf_counter(), time.process_time()
        outcome, figures = DONE, {}
        place: Path | None = None
        try:
            job = self.queue.job(claim.name)
            _adopt(claim)
            place = self.queue.directory / job.record
            with self._observe(job) as observers:
                context = JobContext(job=job, sweep=self.queue.directory, directory=claim.attempt, observers=observers)
                figures = self._function(context)
        except (Exception, SystemExit) as error:
            if self.ending:
                raise
            outcome, figures = FAILED, {"reason": reason_of(error)}
        if not claim.held:
            shutil.rmtree(claim.attempt, ignore_errors=True)
            return None
        figures |= {
            "seconds": time.perf_counter() - begin,
            "cpu_seconds": time.process_time() - used,
            "threads": self.queue.head.threads or available_cores(),
            "worker": self.identity,
            "finished_at": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        }
        if not self._finish(claim, place, outcome, figures):
            return None
        if self._own_process:
            keep_what_is_loaded()
        return Outcome(name=claim.name, outcome=outcome, figures=figures)

    def _finish(self, claim: Claim, place: Path | None, outcome: str, figures: Mapping[str, Any]) -> bool:
        """Put the record in its place, then say that the job is over.

        Returns:
            False where another worker has taken the record: it believes this one dead, and the job is its own.

        Raises:
            EngineError: The disk is full, or the like. The record stays where it is, for whoever does the job next.
        """
        try:
            with writing_whole(self.queue.file(outcome, claim.name), figures):
                if place is not None and not settle(claim.attempt, place) and not claim.held:
                    raise _TakenError
        except _TakenError:
            return False
        except OSError as error:
            reason = f"{error.strerror or error}; it is in the queue again"
            raise EngineError(f"job {claim.name} is over, but this cannot be written: {reason}.") from error
        return True

    def _next(self) -> Claim | None:
        """Claim a job; None where none is to be had now."""
        for scan in (False, True):
            if scan:
                self._left = iter(self._scan())
            for name in self._left:
                if is_ready(self.queue, name) and (claim := take(self.queue, name, worker=self.identity)) is not None:
                    return claim
        return None

    def _scan(self) -> list[str]:
        """Jobs that nobody has, those of dead workers included."""
        return_lost(self.queue, self.settings)
        taken = self.queue.listed(DONE) | self.queue.listed(FAILED) | self.queue.listed(CLAIMS)
        return [name for name in self._names if name not in taken]

    def _waiting(self) -> bool:
        """Whether any job is not over yet."""
        over = self.queue.listed(DONE) | self.queue.listed(FAILED)
        return any(name not in over for name in self._names)


def return_lost(queue: Queue, settings: WorkSettings, *, worker: str | None = None) -> list[str]:
    """Put the jobs of dead workers back into the queue; one that too many died on fails.

    Args:
        queue: The queue.
        settings: After what time a worker counts as dead.
        worker: A worker that is known to be dead; defaults to all that have been silent for too long.

    Returns:
        Names of the jobs.
    """
    if worker is None:
        dead = silent(queue, after=settings.stale_after)
    else:
        dead = [item for item in silent(queue, after=-math.inf) if item[1] == worker]
    found = [name for name, owner in dead if lose(queue, name, worker=owner)]
    count = deaths(queue) if found else {}
    for name in found:
        if count.get(name, 0) >= settings.attempts and not queue.is_over(name):
            reason = f"{count[name]} workers died on it (out of memory, or killed)"
            write_whole(queue.file(FAILED, name), {"reason": reason, "seconds": 0.0})
    return found


def limit_threads(threads: int) -> None:
    """Let numerical libraries take so many threads in this process."""
    os.environ.update(thread_environment(threads))
    if "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(threads)


def keep_what_is_loaded() -> None:
    """Let garbage collection pass over all that there is now, in a process that does nothing but work.

    Runs measure their memory, and collect garbage each time; with all of torch loaded that takes as long as a small run.
    """
    if not gc.get_freeze_count():
        gc.collect()
        gc.freeze()


def reason_of(error: BaseException) -> str:
    """Why a job failed, in a line."""
    return brief(str(error) if isinstance(error, CpdeformError) else f"{type(error).__name__}: {error}", REASON_LENGTH)


@contextlib.contextmanager
def _unobserved(job: Job) -> Iterator[Sequence[Observer]]:
    yield ()


def is_ready(queue: Queue, name: str) -> bool:
    """Whether the job that has to come first, if there is one, is over."""
    try:
        first = queue.job(name).after
    except InputError:
        # Whoever claims it finds out, and says why it cannot be done.
        return True
    return first is None or queue.is_over(first)


def _adopt(claim: Claim) -> None:
    """Make the directory of an attempt, of what an earlier one has left where there is one."""
    earlier: list[Path] = sorted(claim.queue.place(ATTEMPTS).glob(f"{claim.name}@*"))
    for path in earlier:
        if claim.attempt.exists():
            if path != claim.attempt:
                shutil.rmtree(path, ignore_errors=True)
        else:
            with contextlib.suppress(OSError):
                path.rename(claim.attempt)
    claim.attempt.mkdir(parents=True, exist_ok=True)
