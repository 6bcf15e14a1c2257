"""Jobs as tasks of a Ray cluster, whose nodes share the file system that the sweep lies on."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import ray

from cpdeform.core.errors import EngineError, InputError
from cpdeform.core.machine import thread_environment
from cpdeform.core.ray_session import connected
from cpdeform.sweep.claim import silent, take
from cpdeform.sweep.engine import Engine
from cpdeform.sweep.queue import DONE, FAILED, Queue, write_whole
from cpdeform.sweep.worker import Outcome, Worker, WorkSettings, is_ready, return_lost

GIGABYTE = 1e9
LOOK_EVERY = 0.5
"""Seconds between looks at tasks that are not done, and at jobs that others have."""

AHEAD = 2
"""Tasks handed in at the same time, in units of those that can run: the others wait with the driver."""


class EngineRay(Engine):
    """A Ray task for each job, with the processors, GPUs and memory that it needs declared; Ray finds the place.

    A task whose node or process dies is begun anew elsewhere, and goes on where the job broke off.

    Args:
        workers: Tasks at the same time; defaults to as many as the cluster has room for.
        address: Of the cluster, e.g. ``"auto"`` or ``"10.0.0.1:6379"``; defaults to that of ``RAY_ADDRESS``, else to a new one on
            this machine.
        gpus: GPUs of each job; parts of one are possible.
        memory_gb: Memory of each job, 1e9 bytes; None to declare none.

    Raises:
        InputError: A number is out of range.
    """

    def __init__(
        self, *, workers: int | None = None, address: str | None = None, gpus: float = 0.0, memory_gb: float | None = None
    ) -> None:
        super().__init__(workers=workers)
        for name, value in (("gpus", gpus), ("memory_gb", 1.0 if memory_gb is None else memory_gb)):
            if not (isinstance(value, (int, float)) and math.isfinite(value) and value >= 0.0):
                raise InputError(name, came=str(value), expected="a number of at least 0")
        self.address, self.gpus, self.memory_gb = address, gpus, memory_gb

    def work(self, queue: Queue, settings: WorkSettings) -> Iterator[Outcome]:
        """Do all jobs; see `Engine.work`."""
        with connected(self.address):
            yield from _Driver(queue, settings, self).work()

    def resources(self, queue: Queue, settings: WorkSettings) -> dict[str, Any]:
        """What a task declares."""
        threads = queue.head.threads or 1
        declared: dict[str, Any] = {"num_cpus": threads, "max_retries": settings.attempts - 1}
        if self.gpus:
            declared["num_gpus"] = self.gpus
        if self.memory_gb:
            declared["memory"] = int(self.memory_gb * GIGABYTE)
        return {**declared, "runtime_env": {"env_vars": thread_environment(threads)}}


class _Driver:
    """Hands jobs to Ray and waits for them."""

    def __init__(self, queue: Queue, settings: WorkSettings, engine: EngineRay) -> None:
        self._queue, self._settings = queue, settings
        self._task = ray.remote(_do).options(**engine.resources(queue, settings))
        plain = dataclasses.asdict(dataclasses.replace(settings, shard=None, only=None))
        self._request = {"directory": str(queue.directory.resolve()), "settings": plain}
        self._most = engine.workers or AHEAD * max(1, int(ray.cluster_resources().get("CPU", 1)) // (queue.head.threads or 1))
        self._names = settings.own(queue.names())
        self._tasks: dict[Any, str] = {}

    def work(self) -> Iterator[Outcome]:
        """Until all jobs are over."""
        while True:
            waiting = self._hand_in()
            if self._tasks:
                ready, _ = ray.wait(list(self._tasks), num_returns=1, timeout=LOOK_EVERY)
                for task in ready:
                    outcome = self._collect(task, self._tasks.pop(task))
                    if outcome is not None:
                        yield outcome
            elif waiting:
                time.sleep(LOOK_EVERY)
            else:
                return

    def _hand_in(self) -> bool:
        """Hand in as many tasks as there is room for; whether any job is not over."""
        if len(self._tasks) >= self._most:
            return True
        over = self._queue.listed(DONE) | self._queue.listed(FAILED)
        handed = set(self._tasks.values())
        left = [name for name in self._names if name not in over]
        if left:
            return_lost(self._queue, self._settings)
        taken = {name for name, _ in silent(self._queue, after=-math.inf)}
        for name in left:
            if len(self._tasks) >= self._most:
                break
            if name not in handed and name not in taken and is_ready(self._queue, name):
                self._tasks[self._task.remote(self._request, name)] = name
        return bool(left)

    def _collect(self, task: Any, name: str) -> Outcome | None:
        """What came of a task; one that Ray gave up makes the job a failed one."""
        try:
            content: dict[str, Any] | None = ray.get(task)
        except (ray.exceptions.WorkerCrashedError, ray.exceptions.OutOfMemoryError, ray.exceptions.NodeDiedError) as error:
            # Claims of the dead are left for others to see until here.
            reason = f"{self._settings.attempts} workers died on it ({type(error).__name__})"
            write_whole(self._queue.file(FAILED, name), {"reason": reason, "seconds": 0.0})
            return Outcome(name=name, outcome=FAILED, figures={"reason": reason})
        except ray.exceptions.RayError as error:
            raise EngineError(f"Ray could not run job {name}: {str(error).splitlines()[-1]}") from error
        return None if content is None else Outcome(**content)


def _do(request: dict[str, Any], name: str) -> dict[str, Any] | None:
    """Do a job, within a task; None where somebody else has it."""
    queue = Queue(Path(request["directory"]))
    settings = WorkSettings.from_json(request["settings"])
    # A task that Ray begins anew, after its node died, bears the same number: its claim is still its own.
    identity = f"ray-{ray.get_runtime_context().get_task_id()}"
    claim = take(queue, name, worker=identity)
    if claim is None:
        return None
    outcome = Worker(queue, settings, identity=identity, own_process=True).do(claim)
    return None if outcome is None else dataclasses.asdict(outcome)
