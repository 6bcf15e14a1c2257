"""Trial: the best plans of a coarser model, rolled out on the scene itself."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

import torch

from cpdeform.core.errors import InputError
from cpdeform.core.placer import Candidate
from cpdeform.planning.effort import Effort
from cpdeform.planning.phases.choice import best_unlike
from cpdeform.planning.phases.phase import Phase, Scope
from cpdeform.planning.workbench import Workbench


@dataclasses.dataclass(frozen=True, kw_only=True)
class PhaseTrial(Phase):
    """Judge the best candidates of a search by a rollout each; the others leave the race, since their losses are estimates.

    Attributes:
        keep: Number of candidates that are tried.
        name: The phase's name.

    Raises:
        InputError: `keep` is below 1.
    """

    scope: ClassVar[Scope] = "search"
    keep: int
    name: str = "trial"

    def __post_init__(self) -> None:
        if self.keep < 1:
            raise InputError("keep", came=str(self.keep), expected="at least 1")

    def effort(self, candidates: int) -> Effort:
        """See `Phase`."""
        return Effort(rollouts=(0, min(self.keep, candidates)))

    def run(self, bench: Workbench, candidates: list[Candidate]) -> list[Candidate]:
        """All candidates with their plans; finite losses only where a rollout told them."""
        chosen = best_unlike(candidates, self.keep)
        result = [dataclasses.replace(candidate, loss=torch.inf) for candidate in candidates]
        if chosen:
            tried = [candidates[number] for number in chosen]
            losses = bench.rollout_losses(tried, None, phase=self.name).nan_to_num(nan=torch.inf)
            for number, candidate, loss in zip(chosen, tried, losses.tolist(), strict=True):
                result[number] = dataclasses.replace(candidate, loss=loss)
        return result
