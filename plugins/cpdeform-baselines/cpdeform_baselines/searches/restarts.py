"""Random restarts: many random contact plans, the best one kept."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from cpdeform.core.task import Task, merge
from cpdeform.planning.strategies.budget import search_settings
from cpdeform.planning.strategy import Strategy
from cpdeform_baselines.searches.common import EVALUATIONS, count


class StrategyRestarts(Strategy):
    """Multiple restarts: plain Adam from each of some random contact plans a stage, and the best of them is executed.

    Args:
        restarts: Random contact plans of a stage.

    Raises:
        InputError: `restarts` is out of range.

    References:
        Li et al., "Contact Points Discovery for Soft-Body Manipulations with Differentiable Physics", ICLR 2022.
    """

    def __init__(self, *, restarts: int = EVALUATIONS) -> None:
        self.restarts = count("restarts", restarts)

    def settings(self, task: Task, *, placer: str | None) -> Mapping[str, Any]:
        """All plans get all iterations of plain Adam."""
        settings = merge(search_settings(task), {"optimizer": {"pruner": "none", "backtrack": None}, "placer": "random"})
        if placer in (None, "random"):
            settings["placer_options"] = {"candidates": self.restarts, "rounds": 1}
        return settings
