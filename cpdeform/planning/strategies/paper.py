"""Algorithm 1 to the letter."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, ClassVar

from cpdeform.core.task import Task, merge
from cpdeform.planning.strategies.budget import search_settings
from cpdeform.planning.strategy import Strategy

SETTINGS: Mapping[str, Any] = MappingProxyType(
    {
        "optimizer": {"pruner": "none", "backtrack": None},
        "priorities": {"kind": "potential"},
    }
)
"""All candidates get all iterations; priorities are potentials."""

PLACER_OPTIONS: Mapping[str, Mapping[str, Any]] = MappingProxyType(
    {
        "transport": MappingProxyType(
            {"distance_scale": 1.0, "max_gap": None, "proposers": None, "rounds": 1, "contacts": 1, "least_gain": 0.0}
        ),
        "random": MappingProxyType({"rounds": 1}),
    }
)
"""A single contact point a stage; the proposers are the placer's own, by the number of tools."""


class StrategyPaper(Strategy):
    """Algorithm 1 to the letter, on the scene as it is: a task's limits on its tools do not count.

    The budget is that of the default strategy, so that the two compare.

    References:
        Li et al., "Contact Points Discovery for Soft-Body Manipulations with Differentiable Physics", ICLR 2022, Algorithm 1.
    """

    keeps_limits: ClassVar[bool] = False

    def settings(self, task: Task, *, placer: str | None) -> Mapping[str, Any]:
        """The paper's choices above the budget that follows from the task."""
        return merge(merge(search_settings(task), SETTINGS), {"placer_options": PLACER_OPTIONS.get(placer or "transport", {})})
