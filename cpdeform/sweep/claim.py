"""Claims: who does which job, and what becomes of the jobs of workers that died.

A claim spares work, no more: were two workers ever to do the same job, both would make the same of it, and the rename by which a
job is finished keeps one. So nothing here needs locks, which shared file systems keep badly.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path

from cpdeform.core.errors import InputError
from cpdeform.sweep.queue import ATTEMPTS, CLAIMS, LOST, SUFFIX, Queue

STALE_AFTER = 60.0
"""Seconds without a heartbeat after which a worker counts as dead."""

BEATS = 5
"""Heartbeats in that time."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Claim:
    """A job that a worker has taken.

    Attributes:
        queue: The queue.
        name: Name of the job.
        worker: Identity of the worker.
    """

    queue: Queue
    name: str
    worker: str

    @property
    def path(self) -> Path:
        """The claim's file."""
        return self.queue.file(CLAIMS, self.name)

    @property
    def attempt(self) -> Path:
        """Directory for what comes of the job meanwhile."""
        return self.queue.place(ATTEMPTS) / f"{self.name}@{self.worker}"

    @property
    def held(self) -> bool:
        """Whether the claim is still this worker's: one that was silent for too long loses it."""
        return claimant(self.path) == self.worker

    def beat(self) -> None:
        """Say that the worker lives."""
        with contextlib.suppress(OSError):
            os.utime(self.path)

    def release(self) -> None:
        """Give the job back, or let go of one that is over."""
        if self.held:
            self.path.unlink(missing_ok=True)


def take(queue: Queue, name: str, *, worker: str) -> Claim | None:
    """Claim a job by making a file that must not be there.

    Args:
        queue: The queue.
        name: Name of the job.
        worker: Identity of the worker. A claim that bears it already, of an earlier life of the same worker, is taken over.

    Returns:
        The claim; None where another worker has the job, or it is over.
    """
    claim = Claim(queue=queue, name=name, worker=worker)
    if queue.is_over(name):
        return None
    try:
        with os.fdopen(os.open(claim.path, os.O_CREAT | os.O_EXCL | os.O_WRONLY), "w", encoding="utf-8") as file:
            json.dump({"worker": worker}, file)
    except FileExistsError:
        if not claim.held:
            return None
        claim.beat()
    # Another worker may have finished the job between the look and the claim.
    if queue.is_over(name):
        claim.release()
        return None
    return claim


def claimant(path: Path) -> str | None:
    """The worker that a claim's file names; None where there is no such file, or its worker died before it was written."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return str(content.get("worker")) if isinstance(content, dict) else None


def lose(queue: Queue, name: str, *, worker: str | None) -> bool:
    """Put the job of a dead worker back into the queue; its claim is kept among the lost ones, to be counted.

    Args:
        queue: The queue.
        name: Name of the job.
        worker: The worker that was found dead; None where its claim does not name one.

    Returns:
        Whether it was this call that did so.
    """
    path, lost = queue.file(CLAIMS, name), queue.place(LOST) / f"{name}@{os.urandom(6).hex()}{SUFFIX}"
    try:
        path.rename(lost)
    except FileNotFoundError:
        return False
    if claimant(lost) != worker:
        # Somebody else was quicker, and the job is claimed anew: that claim goes back, unless there is one again.
        with contextlib.suppress(OSError):
            os.link(lost, path)
        lost.unlink(missing_ok=True)
        return False
    return True


def deaths(queue: Queue) -> dict[str, int]:
    """How many workers died on each job, of those on which any did."""
    count: dict[str, int] = {}
    for entry in queue.listed(LOST):
        name = entry.rpartition("@")[0]
        count[name] = count.get(name, 0) + 1
    return count


def silent(queue: Queue, *, after: float) -> list[tuple[str, str | None]]:
    """Claims without a heartbeat for some time: name of the job, and the worker.

    Times are compared as the file system gives them: the clocks of several machines differ.

    Args:
        queue: The queue.
        after: How long, seconds.
    """
    found, now = [], file_system_time(queue)
    for name in sorted(queue.listed(CLAIMS)):
        path = queue.file(CLAIMS, name)
        with contextlib.suppress(FileNotFoundError):
            if now - path.stat().st_mtime > after and now - _changed(path) > after:
                found.append((name, claimant(path)))
    return found


def _changed(path: Path) -> float:
    """When a file was changed, as the machine that keeps it has it: NFS clients remember what they saw until a file is opened."""
    with path.open("rb") as file:
        return os.fstat(file.fileno()).st_mtime


def file_system_time(queue: Queue) -> float:
    """Now, seconds, by the clock of the machine that keeps the files."""
    try:
        with tempfile.NamedTemporaryFile(dir=queue.place(CLAIMS), prefix=".clock-") as file:
            os.utime(file.name)
            return os.stat(file.name).st_mtime
    except OSError as error:
        came = f"a directory that cannot be written ({error.strerror or error})"
        raise InputError(f"sweep {queue.directory}", came=came, expected="a writable directory") from error


@contextlib.contextmanager
def heartbeat(claim: Claim, *, stale_after: float) -> Iterator[None]:
    """Keep a claim alive while the block runs."""
    over = threading.Event()

    def beat() -> None:
        while not over.wait(stale_after / BEATS):
            claim.beat()

    thread = threading.Thread(target=beat, name=f"heartbeat of {claim.name}", daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()
