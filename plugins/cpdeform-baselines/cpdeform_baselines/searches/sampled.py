"""Gradients from the best of a sampling round."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from cpdeform.core.task import Task, merge
from cpdeform.planning.phases.descent import PhaseDescent
from cpdeform.planning.phases.phase import Phase
from cpdeform.planning.phases.screening import PhaseScreening
from cpdeform.planning.strategies.budget import search_settings
from cpdeform.planning.strategy import Parts, Strategy
from cpdeform_baselines.searches.common import count
from cpdeform_baselines.searches.mppi import PlacerPathIntegral


class PlacerSamples(PlacerPathIntegral):
    """Samples of contacts and motions, a single round.

    Args:
        samples: Number of samples.
        noise: Standard deviation of the actions, in units of action.

    Raises:
        InputError: An option is out of range.
    """

    def __init__(self, *, samples: int = 64, noise: float = 0.5) -> None:
        super().__init__(samples=samples, updates=1, noise=noise)

    def tell(self, results: list[Any]) -> bool:
        """One round is all."""
        return False


class StrategySampledGradients(Strategy):
    """Random contacts and motions, each judged by a rollout; descent goes on from the best of them.

    Args:
        samples: Samples of a stage.
        keep: How many of them a descent starts from.

    Raises:
        InputError: An option is out of range.
    """

    def __init__(self, *, samples: int = 64, keep: int = 3) -> None:
        self.samples, self.keep = count("samples", samples), count("keep", keep)

    def settings(self, task: Task, *, placer: str | None) -> Mapping[str, Any]:
        """The placer, and the budget of the default strategy."""
        settings = merge(search_settings(task), {"placer": "samples"})
        if placer in (None, "samples"):
            settings["placer_options"] = {"samples": self.samples}
        return settings

    def phases(self, parts: Parts) -> tuple[Phase, ...]:
        """Rollouts of all, then descent of the best."""
        return PhaseScreening(keep=self.keep), PhaseDescent(optimizer=parts.optimizer)
