"""Reading of run records."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import torch
from pydantic import BaseModel, ConfigDict, Field
from torch import Tensor

from cpdeform.core.bounded import MOST_SEED
from cpdeform.core.errors import InputError
from cpdeform.core.reading.arrays import open_arrays
from cpdeform.core.reading.boundary import boundary
from cpdeform.core.reading.json_text import read_json, read_json_lines
from cpdeform.core.reading.limits import ReadingLimits, default_limits
from cpdeform.core.reading.models import validate
from cpdeform.core.state import State
from cpdeform.core.task import Task, beside
from cpdeform.planning.result import StageResult
from cpdeform.run.migration import current_task, goal_file
from cpdeform.run.record_files import METRICS_FILE, RUN_FILE, stage_files, unrevised_files
from cpdeform.run.record_stage import read_stage

MOST_FORMAT = 1000
"""Largest number of a format that a later version may have."""

MOST_BYTES = 2**32
"""Bytes of a stage that a record's task alone does not allow for."""


@dataclasses.dataclass(frozen=True)
class RunRecord:
    """A run as read from its record, finished or not.

    Attributes:
        directory: Where it lies.
        run: Content of ``run.json``: status, versions, machine, configuration, losses; null for a number that is not finite.
        task: What was asked for; its goal is the record's copy.
        goal: Goal particles (M, 3), length units.
        metrics: Lines of ``metrics.jsonl``, iterations and stages in the order of time.
        stages: Stages that are complete, in order; their `history` is empty, see `metrics`.
    """

    directory: Path
    run: dict[str, Any]
    task: Task
    goal: Tensor
    metrics: tuple[dict[str, Any], ...]
    stages: tuple[StageResult, ...]

    @property
    def format(self) -> int:
        """Version of the layout that the record was written in."""
        return int(self.run.get("format", 1))

    @property
    def status(self) -> str:
        """A value of `Status`, or ``"running"`` (also of a run that was killed), ``"interrupted"``, ``"failed"``."""
        return str(self.run["status"])

    @property
    def finished_stages(self) -> int:
        """Number of stages whose plan was executed."""
        return sum(stage.status.executed for stage in self.stages)

    @property
    def first_stage(self) -> int:
        """Number of the stage that the run began with: 0, or that after the record which it went on from."""
        stages = (self.run.get("resumed_from") or {}).get("stages", 0)
        return stages if isinstance(stages, int) else 0

    @property
    def next_stage(self) -> int:
        """Number of the stage that a run going on from here begins with."""
        return self.stages[-1].index + 1 if self.stages else 0

    @property
    def state(self) -> State:
        """State after the last complete stage, a single world on the CPU.

        To go on from it: ``deform(resume=record)``, or ``cpdeform run --resume``.

        Raises:
            InputError: No stage is complete.
        """
        if not self.stages:
            raise InputError(f"run record {self.directory}", came="no complete stage", expected="at least one")
        return self.stages[-1].state


def load_record(directory: Path | str, *, limits: ReadingLimits | None = None) -> RunRecord:
    """Read a run record, of a run that is over, goes on, or was killed.

    Args:
        directory: What `RunRecorder` or `DeformResult.save` wrote.
        limits: How large its files may be; defaults to `cpdeform.core.reading.limits.default_limits`, or to what a stage of the
            record's task takes, if that is more.

    Raises:
        InputError: There is no record, or a file of it is damaged or too large.
    """
    directory = Path(directory)
    argument = f"run record {directory}"
    run = _read_run(directory)
    content = current_task(run["task"], record_format=run.get("format", 1))
    task = validate(Task, beside(content, directory), source=f"{argument}: task")
    # The goal is the record's own copy, wherever the record lies now.
    own = goal_file(directory)
    task = task.model_copy(update={"goal": own})
    limits = limits or _limits(task)
    with boundary(argument, expected="the files of a run record"):
        expected = "the goal of a run record"
        with open_arrays(own, argument=f"{argument}: {own.name}", expected=expected, limits=limits) as file:
            goal = torch.from_numpy(file.read("position", shape=("M", 3), kinds="f", meaning="positions"))
        stages = tuple(_read_stage(path, task, limits) for path in stage_files(directory))
        metrics = tuple(read_json_lines(directory / METRICS_FILE, argument=f"{argument}: {METRICS_FILE}", limits=limits))
    return RunRecord(directory, run, task, goal, metrics, stages)


def with_unrevised_stages(record: RunRecord) -> RunRecord:
    """A record with its stages as they were before the last revision; the record itself where no copies of these are left.

    Raises:
        InputError: A file is damaged or too large.
    """
    files = unrevised_files(record.directory)
    with boundary(f"run record {record.directory}", expected="the files of a run record"):
        before = {index: _read_stage(path, record.task, _limits(record.task)) for index, path in files.items()}
    stages = tuple(before.get(stage.index, stage) for stage in record.stages)
    return dataclasses.replace(record, stages=stages) if before else record


def _read_stage(path: Path, task: Task, limits: ReadingLimits) -> StageResult:
    scene = task.scene
    sizes = {"N": scene.particle_count, "M": len(scene.tools), "A": scene.action_size}
    return read_stage(path, argument=f"run record {path.parent}: {path.name}", sizes=sizes, limits=limits)


def _limits(task: Task) -> ReadingLimits:
    """The default limits, raised to what a stage of the task takes: two states, and positions at all times."""
    limits = default_limits()
    particles = task.scene.particle_count * (3 * (task.rollout_steps + 1) + 2 * 21 + 1)
    return dataclasses.replace(limits, array_bytes=max(limits.array_bytes, min(16 * particles, MOST_BYTES)))


def _read_run(directory: Path) -> dict[str, Any]:
    path = directory / RUN_FILE
    try:
        missing = not path.exists()
    except (OSError, ValueError):
        missing = True
    if missing:
        expected = "a directory that a run was written to"
        raise InputError(f"run record {directory}", came=f"no {RUN_FILE}", expected=expected)
    run = read_json(path, argument=str(path))
    if not isinstance(run, dict) or "task" not in run or "status" not in run:
        raise InputError(str(path), came="something else", expected="the content of a run record")
    validate(RunFields, run, source=str(path))
    return run


class RunFields(BaseModel):
    """What the fields of ``run.json`` hold, as far as other parts of the package use them."""

    model_config = ConfigDict(extra="allow", strict=True)

    format: int = Field(default=1, ge=1, le=MOST_FORMAT)
    status: str
    advice: str = ""
    names: dict[str, str] = Field(default_factory=dict)
    seed: int = Field(default=0, ge=0, le=MOST_SEED)
    stages_finished: int = Field(default=0, ge=0)
    resumed_from: dict[str, Any] | None = None
    recorded_at: str | None = None
    configuration: dict[str, Any] | None = None
    task: dict[str, Any]
    loss_initial: float | None = None
    loss_final: float | None = None
    metric: str | None = None
    metric_initial: float | None = None
    metric_value: float | None = None
    seconds: float | None = None
