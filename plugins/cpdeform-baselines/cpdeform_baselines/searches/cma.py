"""CMA-ES over contact plan and actions at once, without any gradient."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from cpdeform.core.placer import Candidate, Placer, PlacerCapabilities, Proposal, Stage
from cpdeform.core.task import Task, merge
from cpdeform.planning.phases.phase import Phase
from cpdeform.planning.strategies.budget import search_settings
from cpdeform.planning.strategy import Parts, Strategy
from cpdeform_baselines.searches.common import count, rollouts_only, spread, stage_seed
from cpdeform_baselines.searches.contacts import ContactSpace
from cpdeform_baselines.searches.motions import interpolated

KNOTS = 5
"""Moments of a stage whose actions are searched for; those in between are interpolated."""


@dataclasses.dataclass
class _Search:
    """The state of a stage's search."""

    stage: Stage
    space: ContactSpace
    evolution: Any
    points: list[NDArray[np.float64]] = dataclasses.field(default_factory=list)
    proposed: list[int] = dataclasses.field(default_factory=list)
    generation: int = 0


class PlacerEvolution(Placer):
    """Proposes contact plans together with their actions by CMA-ES [1]_; a round is a generation.

    Args:
        generations: Generations of a stage.
        population: Plans of a generation; defaults to 4 + 3 ln(dimensions), but no less than 16.
        knots: Moments of a stage whose actions are searched for; those in between are interpolated.
        sigma: First standard deviation, in a space in which contacts and actions go from -1 to 1.

    Raises:
        InputError: An option is out of range.

    References:
        .. [1] Hansen, "The CMA Evolution Strategy: A Tutorial", 2016.
    """

    capabilities = PlacerCapabilities(needs_priorities=False, max_tools=None)

    def __init__(self, *, generations: int = 20, population: int | None = None, knots: int = KNOTS, sigma: float = 0.5) -> None:
        self.generations, self.knots, self.sigma = count("generations", generations), count("knots", knots), spread("sigma", sigma)
        self.population = None if population is None else count("population", population, least=2)
        self._search: _Search | None = None

    def ask(self, stage: Stage) -> list[Proposal]:
        """Propose a generation: the plans that there is room for.

        Raises:
            CapabilityError: The scene has no movable tool.
        """
        if self._search is None or self._search.stage is not stage:
            self._search = self._begin(stage)
        search, proposals = self._search, []
        search.points, search.proposed = [], []
        shape = (min(self.knots, stage.step_count), stage.scene.action_size)
        for number in range(search.evolution.population_size):
            point = search.evolution.ask()
            search.points.append(point)
            values = torch.as_tensor(point)
            found = search.space.place(0.5 * (values[: search.space.size] + 1.0))
            if found is not None:
                actions = interpolated(values[search.space.size :].reshape(shape), stage.step_count).clamp(-1.0, 1.0)
                label = f"cma-{search.generation + 1}"
                proposals.append(Proposal(found[0], float("nan"), label, found[1], actions.to(torch.float32)))
                search.proposed.append(number)
        return proposals

    def tell(self, results: list[Candidate]) -> bool:
        """Adapt the distribution; ask again as long as generations are left. Plans without room count as the worst."""
        search = self._search
        if search is None:
            return False
        losses = {
            number: result.loss for number, result in zip(search.proposed, results, strict=True) if math.isfinite(result.loss)
        }
        worst = max(losses.values(), default=0.0)
        # A generation's order is all that counts: what cannot be tried comes last.
        told = [(point, losses.get(number, worst + abs(worst) + 1.0)) for number, point in enumerate(search.points)]
        search.evolution.tell(told)
        search.generation += 1
        return search.generation < self.generations and not search.evolution.should_stop()

    def _begin(self, stage: Stage) -> _Search:
        import cmaes

        space = ContactSpace(stage)
        size = space.size + min(self.knots, stage.step_count) * stage.scene.action_size
        population = self.population or max(16, 4 + int(3.0 * math.log(size)))
        evolution = cmaes.CMA(
            mean=np.zeros(size),
            sigma=self.sigma,
            bounds=np.tile([-1.0, 1.0], (size, 1)),
            population_size=population,
            seed=stage_seed(stage),
        )
        return _Search(stage, space, evolution)


class StrategyEvolution(Strategy):
    """Contact plan and actions by CMA-ES: rollouts alone, no gradient.

    Args:
        generations: Generations of a stage.
        population: Plans of a generation; see `PlacerEvolution`.

    Raises:
        InputError: An option is out of range.
    """

    def __init__(self, *, generations: int = 20, population: int | None = None) -> None:
        self.generations = count("generations", generations)
        self.population = None if population is None else count("population", population, least=2)

    def settings(self, task: Task, *, placer: str | None) -> Mapping[str, Any]:
        """The placer, and the loss of the default strategy."""
        settings = merge(search_settings(task), {"placer": "cma"})
        if placer in (None, "cma"):
            settings["placer_options"] = {"generations": self.generations, "population": self.population}
        return settings

    def phases(self, parts: Parts) -> tuple[Phase, ...]:
        """Rollouts."""
        return rollouts_only()
