"""The paper's experiments: tasks, methods and seeds, a run record each, and a table of them all.

Runs are made one after the other in this process, since a simulator uses every core. A record that is there already and belongs to
the same task and configuration is read instead of made again, so that an experiment that was broken off goes on where it was.
"""

from __future__ import annotations

import contextlib
import math
import re
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import AbstractContextManager
from pathlib import Path

import torch

from cpdeform.core.errors import CpdeformError, InputError, RecordError
from cpdeform.core.plugins import Registry
from cpdeform.core.task import Task
from cpdeform.experiments.experiment_plan import (
    BASELINE,
    METHODS,
    REFERENCE,
    TASKS,
    ExperimentSettings,
    PlannedRun,
    configure,
)
from cpdeform.experiments.experiment_row import OVER, ExperimentRow, forget, forget_failure, note_failure, read_row
from cpdeform.planning.result import Observer
from cpdeform.run.configuration import RunConfiguration
from cpdeform.run.record import RunRecorder
from cpdeform.run.record_reader import RunRecord, load_record
from cpdeform.run.resolve import ResolvedRun
from cpdeform.run.resume import recorded_configuration

Observe = Callable[[PlannedRun], AbstractContextManager[Sequence[Observer]]]
"""Gives the observers of a run, for as long as it goes on."""

RECORD_PATTERN = re.compile(rf"({'|'.join(METHODS)})-seed(\d+)")
SAME_GOAL = 1e-6
"""Largest difference between goals that count as the same, length units."""


def run_experiment(
    settings: ExperimentSettings,
    runs: Sequence[PlannedRun],
    *,
    registry: Registry,
    resume: bool = True,
    observe: Observe | None = None,
) -> Iterator[ExperimentRow]:
    """Make every run of an experiment, or read it where it was made before.

    Args:
        settings: What to run.
        runs: Runs of `planned_runs`, in their order.
        registry: Where names are looked up.
        resume: Read finished records with the same task and configuration instead of running again.
        observe: Gives observers of a run, beside its record.

    Returns:
        A row for each run, as it is ready. A run that cannot be made is a row with the reason.
    """
    references: dict[tuple[str, int], ExperimentRow] = {}
    for run in runs:
        iterations = None
        if settings.equal_evaluations and run.method == BASELINE:
            iterations = evaluations_per_stage(references.get((run.task, run.seed)))
        row = _row(run, settings, registry, iterations, resume=resume, observe=observe or _unobserved)
        if run.method == REFERENCE:
            references[run.task, run.seed] = row
        yield row


def evaluations_per_stage(row: ExperimentRow | None) -> int | None:
    """Gradient evaluations that a run used per stage that it tried, rounded up; None where it made none."""
    if row is None or not row.gradient_evaluations or not row.stages_tried:
        return None
    return math.ceil(row.gradient_evaluations / row.stages_tried)


def _row(
    run: PlannedRun, settings: ExperimentSettings, registry: Registry, iterations: int | None, *, resume: bool, observe: Observe
) -> ExperimentRow:
    try:
        resolved = configure(run, settings, registry=registry, iterations=iterations)
        reused = resume and is_done(run.directory, resolved.configuration, resolved.task)
        if reused:
            forget_failure(run)
        else:
            _make(run, resolved, observe)
    except Exception as error:
        return note_failure(run, error)
    return read_row(run, paper_metric=settings.paper_metric, shape=settings.shape, reused=reused)


def _make(run: PlannedRun, resolved: ResolvedRun, observe: Observe) -> None:
    """Run with a record, in place of what is there; a run that breaks off once it has begun says so in its record."""
    recorder = RunRecorder(run.directory, configuration=resolved.configuration, overwrite=True, origins=resolved.origins)
    forget(run)
    try:
        with recorder, observe(run) as observers:
            resolved.run([recorder, *observers])
    except RecordError:
        raise
    except Exception:
        if not recorder.started:
            raise


@contextlib.contextmanager
def _unobserved(run: PlannedRun) -> Iterator[Sequence[Observer]]:
    yield ()


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
        return record.status in OVER and _same_configuration(record, configuration) and _same_task(record, configuration, task)
    except CpdeformError:
        return False


def _same_configuration(record: RunRecord, configuration: RunConfiguration) -> bool:
    apart = {"task", "goal", "stages"}
    recorded = recorded_configuration(record).model_dump(mode="json", exclude=apart)
    return recorded == configuration.model_dump(mode="json", exclude=apart)


def _same_task(record: RunRecord, configuration: RunConfiguration, task: Task) -> bool:
    stages = recorded_configuration(record).stages or record.task.stage_count
    if stages != (configuration.stages or task.stage_count) or record.run.get("resumed_from") is not None:
        return False
    if any(getattr(record.task, name) != getattr(task, name) for name in ("name", "scene", "step_count", "rest_steps", "metric")):
        return False
    goal = torch.as_tensor(task.load_goal()).to(record.goal)
    return goal.shape == record.goal.shape and torch.allclose(goal, record.goal, rtol=0.0, atol=SAME_GOAL)


def recorded_runs(
    out: Path,
    *,
    tasks: Collection[str] | None = None,
    methods: Collection[str] | None = None,
    seeds: Collection[int] | None = None,
) -> list[PlannedRun]:
    """The runs that a directory holds, whatever experiments they come from: by task in the order of `TASKS`, method, seed.

    Args:
        out: Directory of the records.
        tasks: Names of the tasks to look for, with a variant or without; defaults to all.
        methods: Names of the methods; defaults to all.
        seeds: Seeds; defaults to all.

    Raises:
        InputError: There is no such directory, or no run in it.
    """
    runs = []
    for directory in sorted(out.glob("*/*")):
        match = RECORD_PATTERN.fullmatch(directory.name)
        if match is None or not directory.is_dir():
            continue
        task, method, seed = directory.parent.name, match[1], int(match[2])
        if tasks is None or task in tasks or family(task) in tasks:
            run = PlannedRun(task=task, source=task, method=method, seed=seed, directory=directory)
            if (methods is None or method in methods) and (seeds is None or seed in seeds):
                runs.append(run)
    if not runs:
        raise InputError(
            "--out", came=f"{out}, without a run of that kind", expected="a directory that an experiment was written to"
        )
    return sorted(runs, key=_order)


def family(task: str) -> str:
    """A task's name without its variant: ``"move"`` of ``"move-v3"``."""
    return re.sub(r"-v\d+$", "", task)


def _order(run: PlannedRun) -> tuple[int, str, int, int]:
    known = [name for names in TASKS.values() for name in names]
    place = known.index(family(run.task)) if family(run.task) in known else len(known)
    return place, run.task, list(METHODS).index(run.method), run.seed
