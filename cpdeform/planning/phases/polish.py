"""Polish: a few steps of descent for the best candidates of a whole search."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

import torch

from cpdeform.core.errors import InputError
from cpdeform.core.placer import Candidate
from cpdeform.planning.effort import Effort
from cpdeform.planning.optimizer import TrajectoryOptimizer
from cpdeform.planning.phases.choice import best_of_each_kind, best_unlike
from cpdeform.planning.phases.phase import Phase, Scope
from cpdeform.planning.placed import Placing
from cpdeform.planning.workbench import Workbench


@dataclasses.dataclass(frozen=True, kw_only=True)
class PhasePolish(Phase):
    """Go on from the plans of the best candidates by gradient descent; the others stay as they are, or leave the race.

    Attributes:
        keep: Number of candidates that are polished.
        optimizer: How.
        exclusive: Whether the others get an infinite loss: where their losses are estimates, no plan should be chosen by them.
        each_kind: Whether the kinds of candidates take turns, the best of each first.
        placing: Whether the descent also places the tools anew; see `cpdeform.planning.placed`.
        name: The phase's name.

    Raises:
        InputError: `keep` is below 1.
    """

    scope: ClassVar[Scope] = "search"
    keep: int
    optimizer: TrajectoryOptimizer
    exclusive: bool = False
    each_kind: bool = False
    placing: bool = False
    name: str = "polish"

    def __post_init__(self) -> None:
        if self.keep < 1:
            raise InputError("keep", came=str(self.keep), expected="at least 1")

    def effort(self, candidates: int) -> Effort:
        """See `Phase`."""
        return self.optimizer.effort(min(self.keep, candidates))

    def run(self, bench: Workbench, candidates: list[Candidate]) -> list[Candidate]:
        """All candidates, the best of them with better plans; unless `exclusive`, a plan is never worse than before."""
        chosen = (best_of_each_kind if self.each_kind else best_unlike)(candidates, self.keep)
        if not chosen:
            return candidates
        some = [candidates[number] for number in chosen]
        placing = Placing(scene=bench.task.scene) if self.placing else None
        found = bench.minimize(some, self.optimizer, None, phase=self.name, placing=placing)
        assert bench.racing is not None
        result = list(candidates)
        if self.exclusive:
            result = [dataclasses.replace(candidate, loss=torch.inf) for candidate in candidates]
        for place, (number, loss, actions) in enumerate(zip(chosen, found.loss.tolist(), found.actions, strict=True)):
            if loss < result[number].loss:
                result[number] = dataclasses.replace(bench.racing.plan(place, actions), loss=loss)
        return result
