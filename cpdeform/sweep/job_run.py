"""The kind of jobs that plan: each is a run with its record."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cpdeform.core.errors import InputError
from cpdeform.core.plugins import load_registry
from cpdeform.core.task import validate
from cpdeform.sweep.job import JobContext

if TYPE_CHECKING:
    from cpdeform.planning.result import Observer
    from cpdeform.run.record_reader import RunRecord
    from cpdeform.run.resolve import ResolvedRun

FIGURES = ("status", "loss_initial", "loss_final", "metric", "metric_initial", "metric_value", "gradient_evaluations", "rollouts")
"""Fields of a record that count as the figures of a job, beside the number of finished stages."""


BROKEN_OFF = ("running", "interrupted", "failed")
"""Statuses of records of runs that did not come to their end."""


def do_run(context: JobContext) -> dict[str, Any]:
    """Run what a job asks for, fields of `RunConfiguration`; or go on with it where an attempt broke off.

    Returns:
        Figures of the record.
    """
    from cpdeform.run.configuration import RunConfiguration
    from cpdeform.run.resolve import resolve

    configuration = validate(RunConfiguration, dict(context.job.request), source=f"job {context.job.name}")
    record_run(resolve(configuration, registry=load_registry()), context.directory, context.observers)
    return figures(context.directory)


def record_run(resolved: ResolvedRun, directory: Path, observers: Sequence[Observer] = ()) -> None:
    """Run, with a record; where the directory holds finished stages of the same run, go on after them.

    Args:
        resolved: The run, from its start.
        directory: Where the record lies, or is to lie.
        observers: Told of the progress, beside the record.
    """
    from cpdeform.run.record import RunRecorder
    from cpdeform.run.record_continued import RunContinuer
    from cpdeform.run.resolve import resolve

    if _is_over(directory, resolved):
        return
    earlier = _earlier(directory, resolved)
    if earlier is None:
        with RunRecorder(directory, configuration=resolved.configuration, overwrite=True, origins=resolved.origins) as recorder:
            resolved.run([recorder, *observers])
    else:
        with RunContinuer(earlier) as recorder:
            resolve({}, registry=resolved.registry, record=earlier).run([recorder, *observers])


def can_go_on(directory: Path, resolved: ResolvedRun) -> bool:
    """Whether a directory holds finished stages of a run that broke off, the same as the one given."""
    return not _is_over(directory, resolved) and _earlier(directory, resolved) is not None


def figures(directory: Path) -> dict[str, Any]:
    """Figures of a record, for tables."""
    from cpdeform.run.record_reader import load_record

    record = load_record(directory)
    return {name: record.run.get(name) for name in FIGURES} | {"stages": record.finished_stages}


def _earlier(directory: Path, resolved: ResolvedRun) -> RunRecord | None:
    """What an attempt at the same run has left, if it can be gone on from."""
    from cpdeform.run.record_continued import broken_off
    from cpdeform.run.same_run import same_run

    with contextlib.suppress(InputError):
        record = broken_off(directory)
        if record is not None and same_run(record, resolved.configuration, resolved.task):
            return record
    return None


def _is_over(directory: Path, resolved: ResolvedRun) -> bool:
    """Whether an attempt at the same run came to the run's end, and no further."""
    from cpdeform.run.record_reader import load_record
    from cpdeform.run.same_run import same_run

    with contextlib.suppress(InputError):
        record = load_record(directory)
        over = record.status not in BROKEN_OFF and bool(record.stages)
        return over and same_run(record, resolved.configuration, resolved.task)
    return False
