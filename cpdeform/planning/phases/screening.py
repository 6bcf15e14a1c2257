"""Screening: rollouts without gradients choose the candidates that are worth a descent."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

import torch

from cpdeform.core.errors import InputError
from cpdeform.core.objective import Objective
from cpdeform.core.placer import Candidate
from cpdeform.planning.coarse import CoarseModel
from cpdeform.planning.effort import Effort
from cpdeform.planning.optimizer import TrajectoryOptimizer
from cpdeform.planning.phases.phase import Phase, Scope
from cpdeform.planning.workbench import Workbench


@dataclasses.dataclass(frozen=True, kw_only=True)
class PhaseScreening(Phase):
    """Judge every candidate by one rollout of its first actions, and keep the best.

    A rollout without its gradient costs about a fifth, so that many proposals can be looked at for the price of a few descents.
    The candidates should bring first actions of their own: small random ones hardly move the tools and tell nothing.

    Attributes:
        keep: Number of candidates that the next phases go on with; the others get an infinite loss.
        objective: The loss; None for the stage's own.
        coarse: Rolls out with fewer particles, by its own loss; None for all of them.
        initial_noise: Standard deviation of the first actions of candidates that bring none.
        name: The phase's name.

    Raises:
        InputError: `keep` is below 1.
    """

    scope: ClassVar[Scope] = "round"
    keep: int
    objective: Objective | None = None
    coarse: CoarseModel | None = None
    initial_noise: float = 0.01
    name: str = "screening"

    def __post_init__(self) -> None:
        if self.keep < 1:
            raise InputError("keep", came=str(self.keep), expected="at least 1")

    def effort(self, candidates: int) -> Effort:
        """See `Phase`."""
        return Effort(rollouts=(candidates, candidates))

    def run(self, bench: Workbench, candidates: list[Candidate]) -> list[Candidate]:
        """All candidates, the losses of those that are left out infinite."""
        candidates = bench.first_actions(candidates, TrajectoryOptimizer(initial_noise=self.initial_noise))
        if self.coarse is None:
            losses = bench.rollout_losses(candidates, self.objective, phase=self.name)
        else:
            losses = self.coarse.rollout_losses(bench, candidates, phase=self.name)
        order = torch.where(torch.isfinite(losses), losses, torch.inf).argsort(stable=True)
        kept = {int(number) for number in order[: self.keep] if bool(torch.isfinite(losses[number]))}
        return [
            dataclasses.replace(candidate, loss=float(losses[number]) if number in kept else torch.inf)
            for number, candidate in enumerate(candidates)
        ]
