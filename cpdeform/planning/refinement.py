"""A second look at the plan that a stage has chosen, with another objective."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

from torch import Tensor

from cpdeform.core.objective import Objective
from cpdeform.core.simulator import Simulator
from cpdeform.core.state import State
from cpdeform.planning.optimizer import Iteration, OptimizationResult, TrajectoryOptimizer

REFINEMENT = "refinement"
"""`Iteration.phase` of a refinement's iterations, whose losses are in another unit."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Refinement:
    """Goes on from a stage's best plan by an objective that is of use near the goal only.

    Attributes:
        objective: What the refined plan has to lower.
        optimizer: How.
    """

    objective: Objective
    optimizer: TrajectoryOptimizer

    def refine(
        self,
        simulator: Simulator,
        state: State,
        actions: Tensor,
        *,
        rest_steps: int,
        on_iteration: Callable[[Iteration], None] | None = None,
    ) -> OptimizationResult:
        """Refine a plan; without a gain the plan comes back as it was, since it is the first one tried.

        Args:
            simulator: A differentiable backend.
            state: The stage's start, a single world, tools placed.
            actions: The plan (T, A).
            rest_steps: The last steps of T, whose actions are left as they are.
            on_iteration: Called after each iteration.
        """

        def notify(iteration: Iteration) -> None:
            if on_iteration is not None:
                on_iteration(dataclasses.replace(iteration, phase=REFINEMENT))

        self.objective.reset()
        found = self.optimizer.minimize(
            simulator, state, actions.unsqueeze(0), self.objective, rest_steps=rest_steps, on_iteration=notify
        )
        history = tuple(dataclasses.replace(iteration, phase=REFINEMENT) for iteration in found.history)
        return dataclasses.replace(found, history=history)


def gained(found: OptimizationResult) -> bool:
    """Whether a refined plan is better, by the refinement's objective, than the one it began with."""
    first = float(found.history[0].loss[0])
    return float(found.loss[0]) < first
