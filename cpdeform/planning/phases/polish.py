"""Polish: a few steps of descent for the best candidates of a whole search."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
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
        batches: How many times as many are polished, one after the other, while none is better than leaving the clay alone.
        optimizer: How.
        exclusive: Whether the others get an infinite loss: where their losses are estimates, no plan should be chosen by them.
        each_kind: Whether the kinds of candidates take turns, the best of each first.
        placing: Whether the descent also places the tools anew; see `cpdeform.planning.placed`.
        name: The phase's name.

    Raises:
        InputError: `keep` or `batches` is below 1.
    """

    scope: ClassVar[Scope] = "search"
    keep: int
    batches: int = 1
    optimizer: TrajectoryOptimizer
    exclusive: bool = False
    each_kind: bool = False
    placing: bool = False
    name: str = "polish"

    def __post_init__(self) -> None:
        for name, number in (("keep", self.keep), ("batches", self.batches)):
            if number < 1:
                raise InputError(name, came=str(number), expected="at least 1")

    def effort(self, candidates: int) -> Effort:
        """See `Phase`."""
        fewest = self.optimizer.effort(min(self.keep, candidates)).gradients[0]
        most = self.optimizer.effort(min(self.keep * self.batches, candidates)).gradients[1]
        return Effort(gradients=(fewest, most))

    def run(self, bench: Workbench, candidates: list[Candidate]) -> list[Candidate]:
        """All candidates, the best of them with better plans; unless `exclusive`, a plan is never worse than before."""
        chosen = (best_of_each_kind if self.each_kind else best_unlike)(candidates, self.keep * self.batches)
        if not chosen:
            return candidates
        result = list(candidates)
        if self.exclusive:
            result = [dataclasses.replace(candidate, loss=torch.inf) for candidate in candidates]
        for first in range(0, len(chosen), self.keep):
            part = chosen[first : first + self.keep]
            for number, polished in zip(part, self._polished(bench, [candidates[number] for number in part]), strict=True):
                if polished.loss < result[number].loss:
                    result[number] = polished
            if self.batches > 1 and min(result[number].loss for number in part) < bench.loss_to_beat:
                break
        return result

    def _polished(self, bench: Workbench, candidates: Sequence[Candidate]) -> list[Candidate]:
        """The candidates with better plans, and their losses, which may be higher than before where those were estimates."""
        placing = Placing(scene=bench.task.scene) if self.placing else None
        found = bench.minimize(candidates, self.optimizer, None, phase=self.name, placing=placing)
        assert bench.racing is not None
        rows = enumerate(zip(found.loss.tolist(), found.actions, strict=True))
        return [dataclasses.replace(bench.racing.plan(place, actions), loss=loss) for place, (loss, actions) in rows]
