"""Gradient descent through the simulator, of all candidates of a round or of the plan that was chosen."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

import torch

from cpdeform.core.objective import Objective
from cpdeform.core.placer import Candidate
from cpdeform.planning.effort import Effort
from cpdeform.planning.optimizer import SEARCH, TrajectoryOptimizer
from cpdeform.planning.phases.phase import Phase, Scope
from cpdeform.planning.workbench import Workbench

REFINEMENT = "refinement"
"""Name of the phase that goes on from the chosen plan."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class PhaseDescent(Phase):
    """Minimise the stage's objective over the actions of every candidate (paper, Algorithm 1).

    Attributes:
        optimizer: How.
        objective: The loss; None for the stage's own.
        name: The phase's name.
    """

    scope: ClassVar[Scope] = "round"
    optimizer: TrajectoryOptimizer
    objective: Objective | None = None
    name: str = SEARCH

    def effort(self, candidates: int) -> Effort:
        """See `Phase`."""
        return self.optimizer.effort(candidates)

    def run(self, bench: Workbench, candidates: list[Candidate]) -> list[Candidate]:
        """Candidates with the best plan of each; those with an infinite loss are left as they are."""
        candidates = bench.first_actions(candidates, self.optimizer)
        running = [number for number, candidate in enumerate(candidates) if candidate.loss != torch.inf]
        if not running:
            return candidates
        found = bench.minimize([candidates[number] for number in running], self.optimizer, self.objective, phase=self.name)
        result = list(candidates)
        for number, loss, actions, finite in zip(running, found.loss.tolist(), found.actions, found.finite.tolist(), strict=True):
            result[number] = dataclasses.replace(candidates[number], loss=loss, actions=actions, finite=finite)
        return result


@dataclasses.dataclass(frozen=True, kw_only=True)
class PhaseRefinement(Phase):
    """Go on from the stage's chosen plan by an objective that is of use near the goal only; not part of Algorithm 1.

    Attributes:
        objective: What the refined plan has to lower.
        optimizer: How.
        name: The phase's name.
    """

    scope: ClassVar[Scope] = "plan"
    objective: Objective
    optimizer: TrajectoryOptimizer
    name: str = REFINEMENT

    def effort(self, candidates: int) -> Effort:
        """See `Phase`; the plan that it finds is executed."""
        return self.optimizer.effort(1) + Effort(rollouts=(0, 1))

    def run(self, bench: Workbench, candidates: list[Candidate]) -> list[Candidate]:
        """The candidates whose loss fell; the plan itself is the first one tried, so that nothing is lost."""
        found = bench.minimize(candidates, self.optimizer, self.objective, phase=self.name)
        first = found.history[0].loss
        rows = zip(candidates, found.loss.tolist(), first.tolist(), found.actions, strict=True)
        return [dataclasses.replace(candidate, actions=actions) for candidate, loss, before, actions in rows if loss < before]
