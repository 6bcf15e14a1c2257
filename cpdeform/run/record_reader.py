"""Reading of run records."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import h5py
from torch import Tensor

from cpdeform.core.errors import InputError
from cpdeform.core.state import State
from cpdeform.core.task import Task, validate
from cpdeform.planning.result import StageResult, Status
from cpdeform.run.migration import current_task
from cpdeform.run.record_files import METRICS_FILE, RUN_FILE, TARGET_FILE, read_tensor, stage_files
from cpdeform.run.record_stage import read_stage


@dataclasses.dataclass(frozen=True)
class RunRecord:
    """A run as read from its record, finished or not.

    Attributes:
        directory: Where it lies.
        run: Content of ``run.json``: status, versions, machine, configuration, losses; null for a number that is not finite.
        task: What was asked for; its goal is the record's copy.
        target: Goal particles (M, 3), length units.
        metrics: Lines of ``metrics.jsonl``, iterations and stages in the order of time.
        stages: Stages that are complete, in order; their `history` is empty, see `metrics`.
    """

    directory: Path
    run: dict[str, Any]
    task: Task
    target: Tensor
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
        return sum(stage.status is Status.FINISHED for stage in self.stages)

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


def load_record(directory: Path | str) -> RunRecord:
    """Read a run record, of a run that is over, goes on, or was killed.

    Args:
        directory: What `RunRecorder` or `DeformResult.save` wrote.

    Raises:
        InputError: There is no record, or a file of it is damaged.
    """
    directory = Path(directory)
    run = _read_run(directory)
    argument = f"run record {directory}"
    try:
        content = current_task(run["task"], record_format=run.get("format", 1))
        task = validate(Task, content, source=f"{argument}: task")
        # The goal is the record's own copy, wherever the record lies now.
        task = task.model_copy(update={"target": directory / TARGET_FILE})
        with h5py.File(directory / TARGET_FILE, "r") as file:
            target = read_tensor(file, "position")
        stages = tuple(read_stage(path) for path in stage_files(directory))
        metrics = _read_metrics(directory / METRICS_FILE)
    except InputError:
        raise
    except (OSError, KeyError, ValueError) as error:
        raise InputError(argument, came=f"a damaged file ({error})", expected="the files of a run record") from error
    return RunRecord(directory, run, task, target, metrics, stages)


def _read_run(directory: Path) -> dict[str, Any]:
    path = directory / RUN_FILE
    try:
        run = json.loads(path.read_text(encoding="utf-8"))
    except (FileNotFoundError, NotADirectoryError) as error:
        expected = "a directory that a run was written to"
        raise InputError(f"run record {directory}", came=f"no {RUN_FILE}", expected=expected) from error
    except (OSError, ValueError) as error:
        raise InputError(str(path), came=f"unreadable content ({error})", expected="JSON") from error
    if not isinstance(run, dict) or "task" not in run or "status" not in run:
        raise InputError(str(path), came="something else", expected="the content of a run record")
    return run


def _read_metrics(path: Path) -> tuple[dict[str, Any], ...]:
    """Read all lines but a last one that was cut off when the run was killed."""
    lines = path.read_text(encoding="utf-8").split("\n")
    return tuple(json.loads(line) for line in lines[:-1])
