"""Whether a record is that of a certain run."""

from __future__ import annotations

import torch

from cpdeform.core.task import Task
from cpdeform.run.configuration import RunConfiguration
from cpdeform.run.record_reader import RunRecord
from cpdeform.run.record_shapes import scene_content
from cpdeform.run.resume import recorded_configuration

SAME_GOAL = 1e-6
"""Largest difference between goals that count as the same, length units."""


def same_run(record: RunRecord, configuration: RunConfiguration, task: Task) -> bool:
    """Whether a record is that of a run from its start, of the same task with the same configuration.

    Where files lie does not count, nor do versions: scene, goal and schedule are compared as they are in the record.

    Args:
        record: The record, of a run that is over or not.
        configuration: That of the run, names resolved.
        task: The task with the configuration's changes.

    Raises:
        InputError: The record is damaged, or the task's goal cannot be read.
    """
    return _same_configuration(record, configuration) and _same_task(record, configuration, task)


def same_settings(record: RunRecord, configuration: RunConfiguration, task: Task) -> bool:
    """Whether a run that goes on from a record does so with the same scene, parts and settings, whatever its number of stages.

    Args:
        record: The record.
        configuration: That of the run that goes on, names resolved.
        task: Its task, the record's with the configuration's changes.
    """
    same = _same_configuration(record, configuration)
    return same and (record.task.step_count, record.task.rest_steps) == (task.step_count, task.rest_steps)


def _same_configuration(record: RunRecord, configuration: RunConfiguration) -> bool:
    apart = {"task", "goal", "stages", "workers", "executor", "executor_options"}
    recorded = recorded_configuration(record).model_dump(mode="json", exclude=apart)
    return recorded == configuration.model_dump(mode="json", exclude=apart)


def _same_task(record: RunRecord, configuration: RunConfiguration, task: Task) -> bool:
    stages = recorded_configuration(record).stages or record.task.stage_count
    if stages != (configuration.stages or task.stage_count) or record.run.get("resumed_from") is not None:
        return False
    if any(getattr(record.task, name) != getattr(task, name) for name in ("name", "step_count", "rest_steps", "metric")):
        return False
    if scene_content(record.task.scene) != scene_content(task.scene):
        return False
    goal = torch.as_tensor(task.load_goal()).to(record.goal)
    return goal.shape == record.goal.shape and torch.allclose(goal, record.goal, rtol=0.0, atol=SAME_GOAL)
