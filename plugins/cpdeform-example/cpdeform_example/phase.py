"""A phase: variations of the chosen plan, judged by rollouts without gradients."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

import torch

from cpdeform import Candidate, Phase
from cpdeform.planning.phases.phase import Scope
from cpdeform.planning.workbench import Workbench


@dataclasses.dataclass(frozen=True, kw_only=True)
class PhaseVariation(Phase):
    """Tries plans near the one that was chosen; the best of them is executed where it has a lower loss.

    Attributes:
        count: Number of variations.
        noise: Standard deviation of their actions about the plan's, in units of action.
        name: The phase's name.
    """

    scope: ClassVar[Scope] = "plan"
    count: int = 4
    noise: float = 0.05
    name: str = "variation"

    def run(self, bench: Workbench, candidates: list[Candidate]) -> list[Candidate]:
        """The best variation."""
        plan = candidates[0]
        acting = bench.task.step_count
        varied = []
        for _ in range(self.count):
            actions = plan.actions.clone()
            noise = self.noise * torch.randn(actions[:acting].shape, generator=bench.stage.generator)
            actions[:acting] = (actions[:acting] + noise.to(actions)).clamp(-1.0, 1.0)
            varied.append(dataclasses.replace(plan, actions=actions))
        losses = bench.rollout_losses(varied, None, phase=self.name).nan_to_num(nan=torch.inf)
        return [varied[int(losses.argmin())]]

    def accepts(self, loss: float, *, loss_before: float, loss_now: float) -> bool:
        """Only what is better than the plan."""
        return loss < loss_now
