"""How far a sweep is, and what it costs."""

from __future__ import annotations

import csv
import dataclasses
import io
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from cpdeform.core.errors import InputError
from cpdeform.sweep.claim import STALE_AFTER, deaths, silent
from cpdeform.sweep.queue import CLAIMS, DONE, FAILED, JOBS, Queue, write_whole

TABLE_FILE, THROUGHPUT_FILE = "table.csv", "throughput.json"
SECONDS_AN_HOUR = 3600.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class SweepStatus:
    """How far a sweep is.

    Attributes:
        jobs: Number of jobs.
        done: Those that are done.
        failed: Those that cannot be done.
        running: Those that a worker is at.
        silent: Those whose worker has been silent for so long that another one may take over.
        waiting: Those that nobody has begun.
        lost: How often a worker died on a job.
    """

    jobs: int
    done: int
    failed: int
    running: int
    silent: int
    waiting: int
    lost: int

    @property
    def over(self) -> bool:
        """Whether no job is left."""
        return self.done + self.failed == self.jobs


def sweep_status(queue: Queue, *, stale_after: float = STALE_AFTER) -> SweepStatus:
    """Count the jobs of a sweep by listing its directories; no job is read.

    Args:
        queue: The sweep.
        stale_after: Seconds without a heartbeat after which a worker counts as dead.
    """
    jobs, failed = queue.listed(JOBS), queue.listed(FAILED)
    done = queue.listed(DONE) - failed
    claimed = queue.listed(CLAIMS) - done - failed
    dead = {name for name, _ in silent(queue, after=stale_after)} & claimed if claimed else set()
    return SweepStatus(
        jobs=len(jobs),
        done=len(done),
        failed=len(failed),
        running=len(claimed - dead),
        silent=len(dead),
        waiting=len(jobs) - len(done) - len(failed) - len(claimed),
        lost=sum(deaths(queue).values()),
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class Throughput:
    """What the jobs that are done took.

    Attributes:
        plans: How many they are.
        core_hours: Hours of one core, wall time times the threads that each was given.
        cpu_hours: Hours that processors were busy with them.
    """

    plans: int
    core_hours: float
    cpu_hours: float

    @property
    def plans_per_core_hour(self) -> float | None:
        """Plans that a core makes in an hour; None where nothing is done."""
        return self.plans / self.core_hours if self.core_hours else None

    def hours_for(self, plans: int, *, cores: int) -> float | None:
        """Hours that so many cores need for so many plans of that kind; None where nothing is done."""
        rate = self.plans_per_core_hour
        return None if rate is None else plans / rate / cores


def sweep_rows(queue: Queue) -> list[dict[str, Any]]:
    """A row for each job that is over: its name, what it was asked for, its figures; nested fields under dotted names."""
    rows = []
    for name, content in queue.outcomes():
        try:
            request = dict(_flat(queue.job(name).request))
        except InputError:
            request = {}
        rows.append({"job": name, **request, **content})
    return rows


def throughput(rows: Iterable[Mapping[str, Any]]) -> Throughput:
    """What the jobs of a table that are done took."""
    done = [row for row in rows if row["outcome"] == DONE and _number(row.get("seconds")) and _number(row.get("threads"))]
    return Throughput(
        plans=len(done),
        core_hours=sum(row["seconds"] * row["threads"] for row in done) / SECONDS_AN_HOUR,
        cpu_hours=sum(row["cpu_seconds"] for row in done if _number(row.get("cpu_seconds"))) / SECONDS_AN_HOUR,
    )


def write_sweep_table(queue: Queue) -> tuple[list[dict[str, Any]], Throughput]:
    """Write ``table.csv`` and ``throughput.json`` into a sweep's directory.

    Returns:
        The rows, and what they took.
    """
    rows = sweep_rows(queue)
    found = throughput(rows)
    _write_text(queue.directory / TABLE_FILE, csv_text(rows))
    content = {**dataclasses.asdict(found), "plans_per_core_hour": found.plans_per_core_hour}
    write_whole(queue.directory / THROUGHPUT_FILE, {**content, "environment": dict(queue.head.environment)})
    return rows, found


def csv_text(rows: Iterable[Mapping[str, Any]]) -> str:
    """Rows as CSV, a column for every field that any of them has."""
    rows = list(rows)
    names = list(dict.fromkeys(name for row in rows for name in row))
    buffer = io.StringIO()
    writer = csv.DictWriter(buffer, names, restval="", lineterminator="\n")
    writer.writeheader()
    writer.writerows({name: "" if value is None else value for name, value in row.items()} for row in rows)
    return buffer.getvalue()


def _flat(content: Mapping[str, Any], prefix: str = "") -> Iterable[tuple[str, Any]]:
    for key, value in content.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def _number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _write_text(path: Path, text: str) -> None:
    temporary = path.with_name(f".{path.name}.tmp")
    temporary.write_text(text, encoding="utf-8")
    temporary.replace(path)
