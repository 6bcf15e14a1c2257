"""Going on with a run from its record: which state, task and configuration the next run has.

The new run starts from the record's last state. Its task is the record's, scene and goal included, whatever became of the task's
files meanwhile; its configuration is the record's under the changes asked for. Stages go on counting, and the random numbers of
a stage depend on seed and number alone, so that a run that is resumed equals one that went through.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch

from cpdeform.core.errors import InputError
from cpdeform.core.plugins import AUTO
from cpdeform.core.task import Task, changed_task, limited_task, merge, validate
from cpdeform.run.configuration import RunConfiguration
from cpdeform.run.migration import current_configuration
from cpdeform.run.record_reader import RunRecord
from cpdeform.run.record_shapes import scene_content

OPTIONS_OF = {
    "backend": ("simulator_options",),
    "ot": ("ot_options",),
    "placer": ("placer_options",),
    "strategy": ("strategy_options", "placer_options", "optimizer", "objective", "priorities", "refinement"),
}
"""Fields that go with a part; where another part takes its place, the record's are dropped."""


def resumed_values(record: RunRecord, changes: Mapping[str, Any]) -> dict[str, Any]:
    """Values of the configuration of a run that goes on: the record's under the changes.

    Without a change of ``stages`` they are those that the recorded run had left, or one where it had none left.

    Args:
        record: The record.
        changes: Fields of `RunConfiguration` to change, nested.

    Raises:
        InputError: The record's configuration cannot be used.
    """
    base = recorded_configuration(record).model_dump(mode="json")
    for part, fields in OPTIONS_OF.items():
        if part in changes and changes[part] != base[part]:
            base = {field: value for field, value in base.items() if field not in fields}
    planned = base["stages"] or record.task.stage_count
    base["stages"] = max(record.first_stage + planned - record.next_stage, 1)
    return merge(base, changes)


def recorded_configuration(record: RunRecord) -> RunConfiguration:
    """The configuration in a record, with the parts that ran where it says "auto".

    For a run made in Python, which has none, it is the names of its parts and its seed.
    """
    names = {name: value for name, value in record.run.get("names", {}).items() if name in OPTIONS_OF}
    content = record.run.get("configuration")
    if content is None:
        content = {**names, "task": record.task.name, "seed": record.run.get("seed", 0)}
    elif isinstance(content, dict):
        content = current_configuration(content, record_format=record.format)
        content = content | {name: value for name, value in names.items() if content.get(name) == AUTO}
    return validate(RunConfiguration, content, source=f"run record {record.directory}: configuration")


def resumed_task(record: RunRecord) -> Task:
    """The task of a record, to go on with.

    Raises:
        InputError: The record has no complete stage.
    """
    if not record.stages:
        raise InputError(
            f"run record {record.directory}",
            came="no complete stage",
            expected="at least one, to go on from",
            remedy="Run the task from its start, without --resume.",
        )
    return record.task


def check_same_task(record: RunRecord, asked: Task) -> None:
    """Raise `InputError` unless a task is the one that a record was made with.

    Args:
        record: The record.
        asked: The task that was asked for, without the record's changes of its scene.
    """
    remedy = "Leave TASK out to go on with the record's own; change its scene with --set scene.<field>=<value>."
    if asked.name != record.task.name:
        expected = f'"{record.task.name}", the task of run record {record.directory}'
        raise InputError("TASK", came=f'"{asked.name}"', expected=expected, remedy=remedy)
    recorded = _content(record.task)
    changes = recorded_configuration(record)
    # Whether the limits were in force is the strategy's business, which the record does not know.
    tasks = [
        _content(changed_task(task, scene=changes.scene, step_count=changes.steps, rest_steps=changes.rest_steps))
        for task in (limited_task(asked), asked)
    ]
    given = next((task for task in tasks if task["scene"] == recorded["scene"]), tasks[0])
    different = [field for field in ("scene", "step_count", "rest_steps", "metric") if given[field] != recorded[field]]
    goal = torch.as_tensor((asked if changes.goal is None else record.task).load_goal()).to(record.goal)
    if goal.shape != record.goal.shape or not torch.allclose(goal, record.goal, atol=1e-6):
        different.append("goal")
    if different:
        came = f'"{asked.name}" with another {", ".join(different)}'
        raise InputError("TASK", came=came, expected=f"the task as it is in run record {record.directory}", remedy=remedy)


def _content(task: Task) -> dict[str, Any]:
    return {**task.model_dump(exclude={"scene"}), "scene": scene_content(task.scene)}
