"""A job of a sweep, and what its kind is given to do it."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any

from cpdeform.core.errors import InputError

if TYPE_CHECKING:
    from cpdeform.planning.result import Observer

NAME = re.compile(r"[A-Za-z0-9_+][A-Za-z0-9_.+,=-]{0,149}")
"""Names of jobs: what every file system takes."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Job:
    """One piece of work, the same whoever does it.

    Attributes:
        name: Its name, unique in the sweep; see `NAME`.
        record: Directory of what comes of it, relative to the sweep's.
        request: What to do, as the sweep's kind of jobs understands it; plain JSON.
        after: Name of a job that has to be over first.

    Raises:
        InputError: The name cannot be a file's, or `record` leads out of the sweep.
    """

    name: str
    record: str
    request: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    after: str | None = None

    def __post_init__(self) -> None:
        for name in (self.name, *([] if self.after is None else [self.after])):
            if not NAME.fullmatch(name):
                raise InputError("job", came=f'the name "{name}"', expected="letters, digits and _.+,=- (150 at most)")
        path = PurePosixPath(self.record)
        if path.is_absolute() or ".." in path.parts or not path.parts:
            raise InputError(f"job {self.name}: record", came=f'"{self.record}"', expected="a path within the sweep's directory")

    def content(self) -> dict[str, Any]:
        """What its file holds."""
        return {"record": self.record, "after": self.after, "request": dict(self.request)}


@dataclasses.dataclass(frozen=True, kw_only=True)
class JobContext:
    """What the function of a kind of jobs is given.

    Attributes:
        job: What to do.
        sweep: The sweep's directory, in which other jobs' records lie.
        directory: A directory of this attempt's own, to be filled with what comes of the job. It takes the place of `place` once
            the function returns, if there is anything in it. It may hold what an attempt that broke off has left.
        observers: Told of a run's progress.
    """

    job: Job
    sweep: Path
    directory: Path
    observers: Sequence[Observer] = ()

    @property
    def place(self) -> Path:
        """Where what comes of the job belongs; it may hold something already."""
        return self.sweep / self.job.record


JobFunction = Callable[[JobContext], dict[str, Any]]
"""Does a job and returns its figures, plain JSON. What it raises makes the job a failed one, with the reason."""
