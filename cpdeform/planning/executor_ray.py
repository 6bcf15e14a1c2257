"""The executor that spreads batches over a Ray cluster."""

from __future__ import annotations

import functools
import pickle
import uuid
from collections.abc import Callable, Sequence
from types import TracebackType
from typing import Any

import ray

from cpdeform.core.errors import EngineError, InputError
from cpdeform.core.machine import thread_environment
from cpdeform.core.ray_session import connect
from cpdeform.planning.executor import Answer, Item
from cpdeform.planning.executor_processes import TRIES, pack


class ExecutorRay:
    """Computes items as tasks of a Ray cluster; a context manager, at whose end it lets go of the cluster.

    Simulators and objectives go to each of Ray's processes once and stay there. Nodes need cpdeform installed, but no common file
    system. A task whose process or node dies is begun anew elsewhere. A single item is computed in this process.

    Args:
        workers: Tasks at the same time.
        threads: Threads of each, which are also the CPUs that it declares.
        address: Of the cluster, e.g. ``"auto"`` or ``"10.0.0.1:6379"``; defaults to that of ``RAY_ADDRESS``, else to a new one on
            this machine.

    Raises:
        InputError: A number is below 1, or no cluster answers.
    """

    def __init__(self, workers: int, *, threads: int = 1, address: str | None = None) -> None:
        for name, number in (("workers", workers), ("threads", threads)):
            if number < 1:
                raise InputError(name, came=str(number), expected="at least 1")
        self.width, self.threads = workers, threads
        self._own = connect(address, option="executor_options.address")
        environment = {"env_vars": thread_environment(threads)}
        self._task = ray.remote(_compute).options(num_cpus=threads, max_retries=TRIES - 1, runtime_env=environment)
        self._sent: tuple[object, str, Any] | None = None

    def map(self, function: Callable[[Item], Answer], items: Sequence[Item]) -> list[Answer]:
        """Answers in the order of the items; see `cpdeform.planning.executor.Executor.map`.

        Raises:
            InputError: The function, or what is in it, cannot be sent to another process.
            EngineError: Processes or nodes die again and again, or Ray cannot run the tasks.
        """
        if len(items) < 2:
            return [function(item) for item in items]
        contents = [pack(item) for item in items]
        key, sent = self._send(function)
        tasks: list[Any] = []
        running: list[Any] = []
        try:
            for content in contents:
                if len(running) == self.width:
                    _, running = ray.wait(running, num_returns=1)
                tasks.append(self._task.remote(key, sent, content))
                running.append(tasks[-1])
            return [pickle.loads(answer) for answer in ray.get(tasks)]
        except ray.exceptions.RayTaskError as error:
            raise error.cause from error
        except (ray.exceptions.WorkerCrashedError, ray.exceptions.OutOfMemoryError, ray.exceptions.NodeDiedError) as error:
            what = f"processes or nodes died {TRIES} times on the same candidates ({type(error).__name__})"
            raise EngineError(f"{what}. Use fewer workers, or nodes with more memory.") from error
        except ray.exceptions.RayError as error:
            raise EngineError(f"Ray could not compute candidates: {str(error).splitlines()[-1]}") from error
        finally:
            # Where this was broken off, what nobody waits for any more makes room.
            for task in running:
                ray.cancel(task, force=True)

    def close(self) -> None:
        """Let go of the cluster; one of this object's own ends."""
        self._sent = None
        if self._own:
            ray.shutdown()
            self._own = False

    def __enter__(self) -> ExecutorRay:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    def _send(self, function: Callable[[Item], Answer]) -> tuple[str, Any]:
        """The function in the cluster's store, and its name for processes that have it already."""
        if self._sent is None or self._sent[0] != function:
            self._sent = (function, uuid.uuid4().hex, ray.put(pack(function)))
        return self._sent[1], self._sent[2]


class _Kept:
    """A pickled function that is found again by its name, so that a process unpickles it once."""

    def __init__(self, key: str, content: bytes) -> None:
        self.key, self.content = key, content

    def __hash__(self) -> int:
        return hash(self.key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Kept) and other.key == self.key


@functools.lru_cache(maxsize=2)
def _function(kept: _Kept) -> Callable[[Any], Any]:
    function: Callable[[Any], Any] = pickle.loads(kept.content)
    return function


def _compute(key: str, function: bytes, content: bytes) -> bytes:
    """Compute an item, within a task."""
    return pickle.dumps(_function(_Kept(key, function))(pickle.loads(content)), protocol=pickle.HIGHEST_PROTOCOL)
