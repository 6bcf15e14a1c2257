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

from cpdeform.core.errors import EngineError
from cpdeform.core.machine import machine_cores, thread_environment
from cpdeform.sweep.engine import Engine
from cpdeform.sweep.queue import Queue
from cpdeform.sweep.worker import Outcome, Worker, WorkSettings, return_lost

SECONDS_TO_END = 30.0
"""How long workers that were told to end may take: they give their jobs back."""


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
        try:
            while children:
                child, outcome = events.get()
                if outcome is not None:
                    yield outcome
                    continue
                children.discard(child)
                if child.process.wait() != 0 and _died(queue, settings, child, others=bool(children)):
                    children.add(_start(queue, settings, events))
        finally:
            _end(children)


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


def _died(queue: Queue, settings: WorkSettings, child: _Child, *, others: bool) -> bool:
    """Give the job of a child that died back; whether another one may take its place.

    Raises:
        EngineError: It died with nothing done, and it was the last: the next would fare no better.
    """
    if return_lost(queue, settings, worker=child.identity) or child.process.returncode < 0:
        return True
    if not others:
        raise EngineError(f"the workers ended with exit code {child.process.returncode}; see their messages above.")
    return False


def _end(children: set[_Child]) -> None:
    """Tell children to end, and wait for that."""
    for child in children:
        with contextlib.suppress(OSError):
            child.process.terminate()
    for child in children:
        try:
            child.process.wait(timeout=SECONDS_TO_END)
        except subprocess.TimeoutExpired:
            child.process.kill()
            child.process.wait()


def _interrupt(number: int, frame: FrameType | None) -> None:
    raise KeyboardInterrupt


def main() -> None:
    """Work as the request on stdin says; each job that is over is a line of JSON on stdout."""
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    signal.signal(signal.SIGTERM, _interrupt)
    request = json.load(sys.stdin)
    settings = WorkSettings.from_json(request["settings"])
    with answers, contextlib.suppress(KeyboardInterrupt):
        for outcome in Worker(Queue(Path(request["directory"])), settings, identity=request["identity"], own_process=True).work():
            answers.write(json.dumps(dataclasses.asdict(outcome)) + "\n")
            answers.flush()


if __name__ == "__main__":
    main()
