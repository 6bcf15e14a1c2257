"""Workers as processes on this machine, watched by this one."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import signal
import subprocess
import sys
import threading
import uuid
from collections.abc import Iterator
from pathlib import Path
from queue import SimpleQueue
from types import FrameType

from cpdeform.core.errors import CpdeformError, EngineError
from cpdeform.core.machine import machine_cores, thread_environment
from cpdeform.sweep.engine import Engine
from cpdeform.sweep.queue import Queue
from cpdeform.sweep.worker import Outcome, Worker, WorkSettings, return_lost

SECONDS_TO_END = 30.0
"""How long workers that were told to end may take: they give their jobs back."""


DEATHS_IN_VAIN = 10
"""How often, for each worker, processes may die one after the other with no job done between."""


@dataclasses.dataclass(frozen=True)
class _Child:
    """A worker's process, by the name of the worker."""

    identity: str
    process: subprocess.Popen[str]


Event = tuple[_Child, Outcome | None]
"""What a child did; None for its end."""


class EngineLocal(Engine):
    """Worker processes on this machine, each with the threads of a job and no more; one that dies is replaced.

    Args:
        workers: How many; defaults to as many as the cores have room for.
    """

    def work(self, queue: Queue, settings: WorkSettings) -> Iterator[Outcome]:
        """Do all jobs; see `Engine.work`."""
        events: SimpleQueue[Event] = SimpleQueue()
        children = {_start(queue, settings, events) for _ in range(self.workers or room(queue))}
        in_vain, most = 0, len(children) * DEATHS_IN_VAIN
        try:
            while children:
                child, outcome = events.get()
                if outcome is not None:
                    in_vain = 0
                    yield outcome
                    continue
                children.discard(child)
                if child.process.wait() != 0:
                    in_vain += 1
                    _died(queue, settings, child, give_up=in_vain > most)
                    children.add(_start(queue, settings, events))
        finally:
            _end(queue, settings, children)


def room(queue: Queue) -> int:
    """Workers that the machine's cores have room for."""
    return max(1, machine_cores() // (queue.head.threads or machine_cores()))


def _start(queue: Queue, settings: WorkSettings, events: SimpleQueue[Event]) -> _Child:
    identity = uuid.uuid4().hex[:12]
    request = {"directory": str(queue.directory), "identity": identity, "settings": dataclasses.asdict(settings)}
    threads = {} if queue.head.threads is None else thread_environment(queue.head.threads)
    try:
        process = subprocess.Popen(
            [sys.executable, "-P", "-m", "cpdeform.sweep.engines.local"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            errors="replace",
            env={**os.environ, **threads},
        )
    except OSError as error:
        raise EngineError(f"cannot start a worker: {error.strerror or error}.") from error
    if process.stdin is not None:
        # A child that is gone already is found so by whoever listens to it.
        with contextlib.suppress(OSError), process.stdin:
            json.dump(request, process.stdin)
    child = _Child(identity, process)
    threading.Thread(target=_listen, args=(child, events), daemon=True).start()
    return child


def _listen(child: _Child, events: SimpleQueue[Event]) -> None:
    """Pass on what a child says, and its end."""
    if child.process.stdout is not None:
        with child.process.stdout as lines:
            for line in lines:
                # A killed child may leave half a line.
                with contextlib.suppress(ValueError, TypeError):
                    events.put((child, Outcome(**json.loads(line))))
    child.process.wait()
    events.put((child, None))


def _died(queue: Queue, settings: WorkSettings, child: _Child, *, give_up: bool) -> None:
    """Give the job of a child that died back.

    Raises:
        EngineError: It had none, and ended by itself, or too many have died with nothing done: the next would fare no better.
    """
    had_job = bool(return_lost(queue, settings, worker=child.identity))
    if give_up or not (had_job or child.process.returncode < 0):
        raise EngineError(f"workers die with nothing done (exit code {child.process.returncode}); see their messages above.")


def _end(queue: Queue, settings: WorkSettings, children: set[_Child]) -> None:
    """Tell children to end, and wait for that; the job of one that had to be killed goes back."""
    for child in children:
        with contextlib.suppress(OSError):
            child.process.terminate()
    for child in children:
        try:
            child.process.wait(timeout=SECONDS_TO_END)
        except subprocess.TimeoutExpired:
            child.process.kill()
            child.process.wait()
            return_lost(queue, settings, worker=child.identity)


def interrupt_once() -> None:
    """Let the first SIGINT or SIGTERM interrupt this process, and no other: they would break off the giving back of a job.

    Control-C reaches all processes of a terminal, and the one that watches tells its workers to end, too.
    """
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _interrupt)


def _interrupt(number: int, frame: FrameType | None) -> None:
    for other in (signal.SIGINT, signal.SIGTERM):
        signal.signal(other, signal.SIG_IGN)
    raise KeyboardInterrupt


def main() -> None:
    """Work as the request on stdin says; each job that is over is a line of JSON on stdout."""
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    interrupt_once()
    request = json.load(sys.stdin)
    settings = WorkSettings.from_json(request["settings"])
    try:
        with answers, contextlib.suppress(KeyboardInterrupt):
            worker = Worker(Queue(Path(request["directory"])), settings, identity=request["identity"], own_process=True)
            for outcome in worker.work():
                answers.write(json.dumps(dataclasses.asdict(outcome)) + "\n")
                answers.flush()
    except CpdeformError as error:
        sys.stderr.write(f"cpdeform: a worker ends: {error}\n")
        sys.exit(1)


if __name__ == "__main__":
    main()
