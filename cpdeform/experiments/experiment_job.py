"""A run of an experiment as a job: made, or read where it is recorded already."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from cpdeform.core.errors import CpdeformError, RecordError
from cpdeform.core.plugins import load_registry
from cpdeform.core.task import Task
from cpdeform.experiments.experiment_plan import (
    BASELINE,
    REFERENCE,
    ExperimentSettings,
    PlannedRun,
    configure,
    plain_name,
    record_directory,
)
from cpdeform.experiments.experiment_row import OVER, ExperimentRow, forget, forget_failure, note_failure, read_row
from cpdeform.experiments.studies.equal_cost import budget_values, rollout_share
from cpdeform.run.configuration import RunConfiguration
from cpdeform.run.record_files import RUN_FILE
from cpdeform.run.record_reader import load_record
from cpdeform.run.resolve import ResolvedRun
from cpdeform.run.same_run import same_run
from cpdeform.sweep.job import Job, JobContext
from cpdeform.sweep.job_run import can_go_on, record_run
from cpdeform.sweep.settle import settle


def experiment_jobs(settings: ExperimentSettings, runs: Sequence[PlannedRun], *, resume: bool) -> list[tuple[Job, PlannedRun]]:
    """The jobs of an experiment's runs, in their order.

    Args:
        settings: What to run.
        runs: Runs of `planned_runs`.
        resume: Whether finished records are read.
    """
    content = {**_plain(dataclasses.asdict(settings)), "out": "."}
    if settings.goals is not None:
        content["goals"] = str(settings.goals.resolve())
    jobs = []
    for run in runs:
        source = str(Path(run.source).resolve()) if run.source.endswith((".yaml", ".yml")) else run.source
        # The record's place is the job's own; a task of the list may have another name than its file.
        asked = {"task": run.task, "source": source, "method": run.method, "seed": run.seed}
        waits = (settings.equal_evaluations and run.method == BASELINE) or (settings.equal_cost and run.method != REFERENCE)
        job = Job(
            name=_name(run.task, run.method, run.seed),
            record=run.directory.relative_to(settings.out).as_posix(),
            request={"settings": {**content, "tasks": [source]}, "run": asked, "resume": resume},
            after=_name(run.task, REFERENCE, run.seed) if waits else None,
        )
        jobs.append((job, run))
    return jobs


def do_experiment_run(context: JobContext) -> dict[str, Any]:
    """Make a run of an experiment with its record and figures, or read it where it was made before.

    Returns:
        ``reused``: whether it was read.
    """
    request = context.job.request
    settings = _settings(request["settings"], context.sweep)
    run = PlannedRun(**request["run"], directory=context.place)
    try:
        resolved = _configured(context, run, settings)
        if request["resume"] and is_done(context.place, resolved.configuration, resolved.task):
            forget_failure(run)
            return {"reused": True}
        _make(context, resolved)
    except KeyboardInterrupt:
        if (context.directory / RUN_FILE).exists():
            settle(context.directory, context.place)
        raise
    except Exception as error:
        made = dataclasses.replace(run, directory=context.directory)
        row = note_failure(made if any(context.directory.iterdir()) else run, error)
        raise CpdeformError(row.reason) from error
    forget(run)
    read_row(
        dataclasses.replace(run, directory=context.directory),
        paper_metric=settings.paper_metric,
        shape=settings.shape,
        reused=False,
    )
    return {"reused": False}


def _configured(context: JobContext, run: PlannedRun, settings: ExperimentSettings) -> ResolvedRun:
    """A run, ready to start, with the budget that it has beside the reference."""
    registry, reference = load_registry(), None
    if context.job.after is not None:
        directory = record_directory(settings.out, run.task, REFERENCE, run.seed)
        made = dataclasses.replace(run, method=REFERENCE, directory=directory)
        reference = read_row(made, paper_metric=False, reused=True)
    if settings.equal_evaluations and reference is not None:
        return configure(run, settings, registry=registry, iterations=evaluations_per_stage(reference))
    plain = configure(run, settings, registry=registry)
    if not settings.equal_cost:
        return plain
    # Measured with the first run, that of the reference, so that it is there whatever comes of that.
    share = rollout_share(plain.task, plain.configuration, settings.out, registry=registry)
    if reference is None or not reference.stages_tried or reference.gradient_evaluations is None:
        return plain
    cost = (reference.gradient_evaluations + share * (reference.rollouts or 0)) / reference.stages_tried
    stages = plain.configuration.stages or plain.task.stage_count
    iterations = plain.configuration.optimizer.iterations
    budget = budget_values(run.method, cost, share=share, iterations=iterations, stages=stages)
    return configure(run, settings, registry=registry, budget=budget)


def _make(context: JobContext, resolved: ResolvedRun) -> None:
    """Run with a record; a run that breaks off once it has begun says so in its record."""
    _take_up(context, resolved)
    try:
        record_run(resolved, context.directory, context.observers)
    except RecordError:
        raise
    except Exception:
        if not (context.directory / RUN_FILE).exists():
            raise


def _take_up(context: JobContext, resolved: ResolvedRun) -> None:
    """Go on with a run of the same configuration that broke off and whose record was put in its place."""
    if not any(context.directory.iterdir()) and can_go_on(context.place, resolved):
        context.directory.rmdir()
        context.place.rename(context.directory)


def _settings(content: Mapping[str, Any], out: Path) -> ExperimentSettings:
    """Settings as they are in a job."""
    values: dict[str, Any] = {name: tuple(value) if isinstance(value, list) else value for name, value in content.items()}
    goals = content.get("goals")
    values |= {"out": out, "goals": None if goals is None else Path(goals)}
    return ExperimentSettings(**values)


def _plain(content: Any) -> dict[str, Any]:
    """As it is after a way through JSON."""
    plain: dict[str, Any] = json.loads(json.dumps(content, default=str))
    return plain


def _name(task: str, method: str, seed: int) -> str:
    """Name of a run's job."""
    return f"{plain_name(task)}-{method}-seed{seed}"


def evaluations_per_stage(row: ExperimentRow | None) -> int | None:
    """Gradient evaluations that a run used per stage that it tried, rounded up; None where it made none."""
    if row is None or not row.gradient_evaluations or not row.stages_tried:
        return None
    return math.ceil(row.gradient_evaluations / row.stages_tried)


def is_done(directory: Path, configuration: RunConfiguration, task: Task) -> bool:
    """Whether a directory holds the record of a run that came to its end, of the same task with the same configuration.

    Where files lie does not count, nor do versions: scene, goal and schedule are compared as they are in the record.

    Args:
        directory: Where the record would be.
        configuration: That of the run to be made, names resolved.
        task: The task with the configuration's changes.
    """
    try:
        record = load_record(directory)
        return record.status in OVER and same_run(record, configuration, task)
    except CpdeformError:
        return False
