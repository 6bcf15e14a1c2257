"""The default strategy: contact points discovery with a race of the candidates, for any task."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from cpdeform.core.task import Task
from cpdeform.planning.strategies.budget import LONG_STAGE, search_settings
from cpdeform.planning.strategy import Strategy

ROUNDS, LONG_ROUNDS = 4, 2
"""Rounds of candidates of a stage, and of one that is long and the only one."""


class StrategyCpdeform(Strategy):
    """Algorithm 1 with candidates that race each other and come back from dead ends; budget and step size follow from the task.

    A task of a single long stage also tries its tools from where they are: a scene may have them in place.
    """

    def settings(self, task: Task, *, placer: str | None) -> Mapping[str, Any]:
        """Settings that follow from the task's schedule, its tools' speed and their number."""
        settings = search_settings(task)
        if (placer or "transport") == "transport":
            settings["placer_options"] = {"rounds": ROUNDS}
            if task.stage_count == 1 and task.step_count >= LONG_STAGE:
                settings["placer_options"] = {"rounds": LONG_ROUNDS, "proposers": ["current", *_proposers(task)]}
        return settings


def _proposers(task: Task) -> list[str]:
    """The proposers that the paper has for the scene's tools."""
    movable = sum(tool.movable for tool in task.scene.tools)
    return ["direct"] if movable == 1 else ["left-right", "top-bottom", "front-back"]
