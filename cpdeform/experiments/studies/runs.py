"""The runs that a study's figures are made from: rows of the table with their records."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from pathlib import Path

from cpdeform.core.errors import CpdeformError
from cpdeform.experiments.experiment_plan import METHODS, record_directory
from cpdeform.experiments.experiment_row import ExperimentRow
from cpdeform.run.record_reader import RunRecord, load_record


@dataclasses.dataclass(frozen=True)
class StudyRun:
    """A run.

    Attributes:
        row: Its row of the table.
        record: Its record; None for one that failed.
    """

    row: ExperimentRow
    record: RunRecord | None


def study_runs(rows: Sequence[ExperimentRow], out: Path) -> list[StudyRun]:
    """The runs of rows, with the records that belong to them."""
    return [StudyRun(row, _record(row, out)) for row in rows]


def _record(row: ExperimentRow, out: Path) -> RunRecord | None:
    if not row.over:
        return None
    try:
        return load_record(record_directory(out, row.task, row.method, row.seed))
    except CpdeformError:
        return None


def tasks_of(runs: Iterable[StudyRun]) -> list[str]:
    """Tasks in the order in which they came."""
    return list(dict.fromkeys(run.row.task for run in runs))


def methods_of(runs: Iterable[StudyRun]) -> list[str]:
    """Methods in the order of the table."""
    there = {run.row.method for run in runs}
    return [method for method in METHODS if method in there]


def chosen(runs: Iterable[StudyRun], task: str, method: str) -> list[StudyRun]:
    """The runs of a method on a task, by seed."""
    found = [run for run in runs if run.row.task == task and run.row.method == method]
    return sorted(found, key=lambda run: run.row.seed)
