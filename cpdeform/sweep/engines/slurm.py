"""Workers as an array of Slurm jobs, submitted through submitit; they share the file system that the sweep lies on."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import submitit
from submitit.helpers import DelayedSubmission

from cpdeform.core.errors import EngineError, InputError
from cpdeform.core.machine import thread_environment
from cpdeform.sweep.engine import Engine
from cpdeform.sweep.queue import DONE, FAILED, QUEUE, Queue
from cpdeform.sweep.worker import Outcome, Worker, WorkSettings

LOOK_EVERY = 2.0
"""Seconds between looks at the queue."""

SECONDS_TO_END = 60.0
"""How long workers may take to see that the sweep is over."""

LOGS = "slurm"
"""Directory of submitit's files, in that of the queue."""

MOST_TIMEOUTS = 1000
"""How often a worker may reach the end of its time and be queued again."""


class SlurmWorker:
    """What an array's job does: work until no job of the sweep is left.

    Before its time is over, or where it is preempted, submitit asks it for a `checkpoint` and queues it again. The job in hand goes
    back to the queue, and whoever takes it goes on after its last finished stage.

    Args:
        directory: The sweep's.
        settings: How to go about it.
    """

    def __init__(self, directory: str, settings: WorkSettings) -> None:
        self.directory, self.settings = directory, settings
        self._worker: Worker | None = None

    def __call__(self) -> int:
        """Work; how many jobs were done."""
        self._worker = Worker(Queue(Path(self.directory)), self.settings, own_process=True)
        return sum(1 for _ in self._worker.work())

    def checkpoint(self) -> DelayedSubmission:
        """What to queue again: the same, since the directory holds all that there is to know.

        Submitit ends the process right after it.
        """
        if self._worker is not None:
            self._worker.ending = True
        return DelayedSubmission(SlurmWorker(self.directory, self.settings))


class EngineSlurm(Engine):
    """An array of Slurm jobs, each a worker.

    Interrupting the command cancels the array.

    Args:
        workers: Jobs of the array; has to be given with Slurm itself.
        cluster: What submitit submits to: ``"slurm"``, or ``"local"`` for processes on this machine.
        timeout_min: Time limit of a job of the array, minutes; it is queued again as long as the sweep goes on.
        memory_gb: Memory of each, gigabytes; defaults to the cluster's.
        gpus: GPUs of each.
        slurm: Further parameters, such as ``{"partition": "long", "account": "clay"}``, as submitit has them.
        wait: Whether to wait for the end of the sweep; otherwise the command ends once the array is submitted.

    Raises:
        InputError: A number is out of range, or `workers` is missing.
    """

    def __init__(
        self,
        *,
        workers: int | None = None,
        cluster: str = "slurm",
        timeout_min: int = 240,
        memory_gb: float | None = None,
        gpus: int = 0,
        slurm: Mapping[str, Any] | None = None,
        wait: bool = True,
    ) -> None:
        super().__init__(workers=workers)
        if workers is None:
            raise InputError("--workers", came="nothing", expected="the number of jobs of the array, for the engine slurm")
        if cluster not in ("slurm", "local"):
            raise InputError("cluster", came=f'"{cluster}"', expected='"slurm" or "local"')
        if not (isinstance(timeout_min, int) and timeout_min >= 1):
            raise InputError("timeout_min", came=str(timeout_min), expected="a whole number of minutes of at least 1")
        self.cluster, self.wait = cluster, wait
        self.parameters: dict[str, Any] = {"timeout_min": timeout_min, "mem_gb": memory_gb, "gpus_per_node": gpus or None}
        self.parameters |= {f"slurm_{name}": value for name, value in (slurm or {}).items()} if cluster == "slurm" else {}
        self.jobs: list[submitit.Job[int]] = []

    def work(self, queue: Queue, settings: WorkSettings) -> Iterator[Outcome]:
        """Do all jobs; see `Engine.work`."""
        names = set(settings.own(queue.names()))
        told = _over(queue, names)
        self.jobs = self._submit(queue, settings)
        if not self.wait:
            return
        try:
            while told != names:
                ended = all(job.done() for job in self.jobs)
                found = _over(queue, names) - told
                for name, content in queue.outcomes(found):
                    told.add(name)
                    outcome = content.pop("outcome")
                    yield Outcome(name=name, outcome=outcome, figures=content)
                if ended and not found:
                    raise EngineError(_why(self.jobs, queue))
                time.sleep(0.0 if found else LOOK_EVERY)
        except BaseException:
            for job in self.jobs:
                with contextlib.suppress(Exception):
                    job.cancel(check=False)
            raise
        _wait(self.jobs)

    def _submit(self, queue: Queue, settings: WorkSettings) -> list[submitit.Job[int]]:
        threads = queue.head.threads or 1
        timeouts = {f"{self.cluster}_max_num_timeout": MOST_TIMEOUTS}
        worker = SlurmWorker(str(queue.directory.resolve()), settings)
        try:
            executor = submitit.AutoExecutor(folder=queue.directory / QUEUE / LOGS, cluster=self.cluster, **timeouts)
            executor.update_parameters(name="cpdeform", cpus_per_task=threads, **self.parameters)
            # A worker reads the number of its threads when it loads its libraries, before any of this project's code can set it.
            with submitit.helpers.environment_variables(**thread_environment(threads)), executor.batch():
                return [executor.submit(worker) for _ in range(self.workers or 1)]
        except (RuntimeError, NameError, AssertionError, submitit.core.utils.FailedJobError) as error:
            raise EngineError(f"cannot submit to {self.cluster}: {str(error).splitlines()[0]}") from error


def _wait(jobs: list[submitit.Job[int]]) -> None:
    """Wait for workers that have nothing left to do."""
    limit = time.monotonic() + SECONDS_TO_END
    while not all(job.done() for job in jobs) and time.monotonic() < limit:
        time.sleep(LOOK_EVERY / 10.0)


def _over(queue: Queue, names: set[str]) -> set[str]:
    return (queue.listed(DONE) | queue.listed(FAILED)) & names


def _why(jobs: list[submitit.Job[int]], queue: Queue) -> str:
    """Why all workers ended although jobs are left."""
    for job in jobs:
        with contextlib.suppress(Exception):
            error = job.exception()
            if error is not None:
                lines = [line for line in str(error).splitlines() if line.strip()]
                return f"the workers ended before the sweep was over: {lines[-1] if lines else type(error).__name__}"
    return f"the workers ended before the sweep was over; see their messages in {queue.directory / QUEUE / LOGS}."
