"""The queue of a sweep: a directory of small files, on any file system that several machines share.

``sweep.json``
    Kind of the jobs, threads of each, and what was asked for. It is written last: without it there is no sweep.
``queue/jobs/NAME.json``
    What to do. These files never change.
``queue/claims/NAME.json``
    Made, with ``O_EXCL``, by the worker that does the job; the time of its last change is the worker's heartbeat.
``queue/lost/NAME@WORKER.json``
    The claim of a worker that died on the job.
``queue/attempts/NAME@WORKER/``
    What comes of the job, while it is being done.
``queue/done/NAME.json``, ``queue/failed/NAME.json``
    Figures of a job that is done, or why it cannot be. They appear by a rename: with it the job is over.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
from collections.abc import Collection, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from cpdeform.core.errors import InputError
from cpdeform.core.reading.json_text import read_json
from cpdeform.sweep.job import Job

SWEEP_FILE, QUEUE = "sweep.json", "queue"
FORMAT = 1
"""Version of the layout."""

JOBS, CLAIMS, LOST, ATTEMPTS, DONE, FAILED = "jobs", "claims", "lost", "attempts", "done", "failed"
PLACES = (JOBS, CLAIMS, LOST, ATTEMPTS, DONE, FAILED)
SUFFIX = ".json"


@dataclasses.dataclass(frozen=True, kw_only=True)
class SweepHead:
    """What ``sweep.json`` says.

    Attributes:
        kind: Registered name of the kind of jobs.
        threads: Threads of each job; None where that is left to the machine.
        asked: What the sweep was made from, plain JSON.
        environment: Versions and machine that it was made with.
    """

    kind: str
    threads: int | None = None
    asked: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    environment: Mapping[str, Any] = dataclasses.field(default_factory=dict)


class Queue:
    """The jobs of a sweep and who does them; see the module.

    Args:
        directory: The sweep's directory.

    Raises:
        InputError: There is no sweep, or one of a later version.
    """

    def __init__(self, directory: Path | str) -> None:
        self.directory = Path(directory)
        self.head = self._read_head()

    @classmethod
    def create(cls, directory: Path | str, head: SweepHead, jobs: Iterable[Job], *, replace: bool = False) -> Queue:
        """Make a sweep, or complete one that was left half made; one that is there with the same jobs is taken as it is.

        Args:
            directory: Where; made if missing.
            head: What all jobs have in common.
            jobs: All jobs, each name once.
            replace: Let jobs and the head take the place of others that are there.

        Raises:
            InputError: Another sweep is there, or it cannot be written.
        """
        directory = Path(directory)
        try:
            for place in PLACES:
                (directory / QUEUE / place).mkdir(parents=True, exist_ok=True)
            _write_jobs(directory / QUEUE / JOBS, jobs, argument=f"sweep {directory}", replace=replace)
            if replace or not (directory / SWEEP_FILE).exists():
                content = {"format": FORMAT, **dataclasses.asdict(head)}
                write_whole(directory / SWEEP_FILE, content)
        except OSError as error:
            came = f"a path that cannot be written ({error.strerror or error})"
            raise InputError(f"sweep {directory}", came=came, expected="a writable directory") from error
        queue = cls(directory)
        if (queue.head.kind, queue.head.threads) != (head.kind, head.threads):
            came = f"a sweep of kind {queue.head.kind} with {queue.head.threads} threads a job"
            raise InputError(
                f"sweep {directory}", came=came, expected=f"kind {head.kind} with {head.threads}, or another directory"
            )
        return queue

    def place(self, name: str) -> Path:
        """One of the queue's directories."""
        return self.directory / QUEUE / name

    def file(self, place: str, name: str) -> Path:
        """The file of a job in one of the queue's directories."""
        return self.directory / QUEUE / place / f"{name}{SUFFIX}"

    def names(self) -> list[str]:
        """Names of all jobs, in order."""
        return sorted(self.listed(JOBS))

    def listed(self, place: str) -> set[str]:
        """Names of the jobs that have a file in one of the queue's directories."""
        with contextlib.suppress(FileNotFoundError), os.scandir(self.place(place)) as entries:
            return {entry.name[: -len(SUFFIX)] for entry in entries if entry.name.endswith(SUFFIX) and entry.name[0] != "."}
        return set()

    def is_over(self, name: str) -> bool:
        """Whether a job is done or has failed."""
        return self.file(DONE, name).exists() or self.file(FAILED, name).exists()

    def job(self, name: str) -> Job:
        """Read a job.

        Raises:
            InputError: Its file is missing or damaged.
        """
        path = self.file(JOBS, name)
        content = read_json(path, argument=f"job {path}")
        if not isinstance(content, dict) or not isinstance(content.get("request"), dict):
            raise InputError(f"job {path}", came="something else", expected="the content of a job")
        after = content.get("after")
        after = None if after is None else str(after)
        return Job(name=name, record=str(content.get("record")), request=content["request"], after=after)

    def outcomes(self, names: Collection[str] | None = None) -> Iterator[tuple[str, dict[str, Any]]]:
        """What came of the jobs that are over, in the order of their names; a damaged file is told as the reason.

        Args:
            names: The jobs to look at; defaults to all.
        """
        over = {name: place for place in (FAILED, DONE) for name in self.listed(place)}
        for name in sorted(over if names is None else over.keys() & set(names)):
            path = self.file(over[name], name)
            try:
                content = read_json(path, argument=f"outcome {path}")
            except InputError as error:
                content = {"reason": str(error)}
            yield name, {"outcome": over[name], **(content if isinstance(content, dict) else {})}

    def forget(self, name: str) -> None:
        """Let a job be done again: what came of it, and the claims of workers that died on it, count no more."""
        for place in (DONE, FAILED):
            self.file(place, name).unlink(missing_ok=True)
        for path in self.place(LOST).glob(f"{name}@*{SUFFIX}"):
            path.unlink(missing_ok=True)

    def _read_head(self) -> SweepHead:
        path = self.directory / SWEEP_FILE
        if not path.is_file():
            remedy = "Make one with `cpdeform sweep new`."
            raise InputError(f"sweep {self.directory}", came=f"no {SWEEP_FILE}", expected="the directory of a sweep", remedy=remedy)
        content = read_json(path, argument=str(path))
        known = isinstance(content, dict) and content.get("format") == FORMAT
        if not known or not isinstance(content.get("kind"), str) or not isinstance(content.get("asked"), dict):
            raise InputError(str(path), came="something else, or a later version", expected=f"a sweep of format {FORMAT}")
        threads = content.get("threads")
        if threads is not None and not (isinstance(threads, int) and threads >= 1):
            raise InputError(f"{path}: threads", came=str(threads), expected="a whole number of at least 1")
        environment = content.get("environment")
        return SweepHead(
            kind=content["kind"],
            threads=threads,
            asked=content["asked"],
            environment=environment if isinstance(environment, dict) else {},
        )


def write_whole(path: Path, content: Mapping[str, Any]) -> None:
    """Write a JSON file so that others see all of it or none; whoever writes the same file does not get in the way."""
    with writing_whole(path, content):
        pass


@contextlib.contextmanager
def writing_whole(path: Path, content: Mapping[str, Any]) -> Iterator[None]:
    """Write a JSON file, which appears as a whole at the end of the block, unless that raises.

    It is on the disk before the block begins: where the disk is full, nothing of the block is done.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}-{os.urandom(4).hex()}")
    try:
        with temporary.open("w", encoding="utf-8") as file:
            json.dump(content, file)
            file.flush()
            os.fsync(file.fileno())
        yield
        temporary.replace(path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def _write_jobs(directory: Path, jobs: Iterable[Job], *, argument: str, replace: bool) -> None:
    """Write the files of jobs that are not there; one that is there has to be the same, unless it is to be replaced."""
    with os.scandir(directory) as entries:
        there = {entry.name for entry in entries}
    for job in jobs:
        path, text = directory / f"{job.name}{SUFFIX}", json.dumps(job.content())
        if path.name not in there or (replace and path.read_text(encoding="utf-8") != text):
            # Not every one is forced to the disk: without sweep.json, which is, there is no sweep.
            temporary = directory / f".{path.name}"
            temporary.write_text(text, encoding="utf-8")
            temporary.replace(path)
        elif path.read_text(encoding="utf-8") != text:
            remedy = "Choose another directory."
            raise InputError(argument, came=f"a sweep with another job {job.name}", expected="the same jobs", remedy=remedy)
