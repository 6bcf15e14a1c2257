"""The default strategy: contact points discovery with a race of the candidates, for any task."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from cpdeform.core.task import Task
from cpdeform.planning.strategies.budget import search_settings
from cpdeform.planning.strategy import Strategy

SEVERAL_ROUNDS, FEW_ROUNDS = 4, 2
"""Rounds of candidates of a stage where others follow, and of one that is the only one."""


class StrategyCpdeform(Strategy):
    """Algorithm 1 with candidates that race each other and come back from dead ends; budget and step size follow from the task.

    A task of a single stage also tries its tools from where they are: a scene may have them in place.
    """

    def settings(self, task: Task, *, placer: str | None) -> Mapping[str, Any]:
        """Settings that follow from the task's schedule, its tools' speed and their number."""
        settings = search_settings(task)
        if (placer or "transport") == "transport":
            several = task.stage_count > 1
            settings["placer_options"] = {"rounds": SEVERAL_ROUNDS if several else FEW_ROUNDS}
            if not several:
                settings["placer_options"]["proposers"] = ["current", *_proposers(task)]
        return settings


def _proposers(task: Task) -> list[str]:
    """The proposers that the paper has for the scene's tools."""
    movable = sum(tool.movable for tool in task.scene.manipulators)
    return ["direct"] if movable == 1 else ["left-right", "top-bottom", "front-back"]
