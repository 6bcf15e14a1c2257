"""The state of a descent of many candidates at once, all of it explicit: who is still running, the best so far, warm starts."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence

import torch
from torch import Tensor

from cpdeform.core.memory import MemoryUse
from cpdeform.core.state import State
from cpdeform.planning.batches import Evaluation, Evaluator, Warm, evaluate_worlds
from cpdeform.planning.descent import Descent
from cpdeform.planning.executor import Executor


@dataclasses.dataclass
class Race:
    """B worlds on their way down.

    Attributes:
        state: Start of the B worlds.
        descent: Their actions and Adam's moments.
        active: Indices (b,) of the worlds that are still running, ascending.
        warm: What the objective can start from in each world, B entries.
        best_actions: Best actions (B, T, A).
        best_ends: Final positions (B, N, 3) of the best plans.
        best_loss: Their loss (B,) in float64; infinity where no evaluation was finite.
        reference: Loss (B,) that the next improvement is measured from.
        finite: Worlds (B,) whose every loss and gradient were finite.
        evaluations: Gradients computed, of all worlds together.
    """

    state: State
    descent: Descent
    active: Tensor
    warm: Warm
    best_actions: Tensor
    best_ends: Tensor
    best_loss: Tensor
    reference: Tensor
    finite: Tensor
    evaluations: int = 0

    @classmethod
    def begin(
        cls,
        state: State,
        actions: Tensor,
        *,
        backtrack: int | None,
        warm: Sequence[object] | None,
        leap: float | None = None,
    ) -> Race:
        """All worlds at their first actions (B, T, A); see `Descent` for `backtrack` and `leap`."""
        count = state.batch_size
        first = actions.detach().clone().to(state.position)
        worst = torch.full((count,), torch.inf, dtype=torch.float64)
        return cls(
            state=state,
            descent=Descent(first, backtrack=backtrack, leap=leap),
            active=torch.arange(count),
            warm=[None] * count if warm is None else list(warm),
            best_actions=first,
            best_ends=state.position.detach().clone(),
            best_loss=worst,
            reference=worst.clone(),
            finite=torch.ones(count, dtype=torch.bool),
        )

    def step(
        self, evaluator: Evaluator, executor: Executor, *, rest_steps: int, learning_rate: float, measured: bool
    ) -> tuple[Tensor, Tensor, dict[str, float], MemoryUse | None]:
        """Evaluate the active worlds and let each of them take a step; those that broke for good are active no more.

        Args:
            evaluator: Computes losses and gradients.
            executor: Where.
            rest_steps: The last steps of T, whose actions are left as they are.
            learning_rate: Adam's step size, in units of action.
            measured: Whether to measure the memory.

        Returns:
            Loss (B,) of the actions tried and Euclidean norm (B,) of its gradient, nan of worlds that are not active; wall times;
            memory, where it was measured.
        """
        active, tried = self.active, self.descent.actions(self.active)
        found = evaluate_worlds(
            evaluator,
            executor,
            self._worlds(),
            tried,
            warm=[self.warm[world] for world in active.tolist()],
            stand_ins=self.best_ends[active.to(self.best_ends.device)],
            measured=measured,
        )
        tried = found.actions.to(tried)
        self.descent.put(active, tried)
        gradient = _with_rest(found, rest_steps)
        self.evaluations += len(active)
        for place, world in enumerate(active.tolist()):
            self.warm[world] = None if found.warm is None else found.warm[place]
        unknown = torch.full_like(self.best_loss, torch.nan)
        loss = unknown.index_copy(0, active, found.loss)
        norm = unknown.index_copy(0, active, gradient.flatten(1).double().norm(dim=1).cpu())
        sound = torch.isfinite(found.loss) & torch.isfinite(gradient).flatten(1).all(dim=1).cpu()
        self.finite[active] &= sound
        going = sound | self.descent.can_return(active)
        self._keep_best(loss, tried, found.ends)
        start = time.perf_counter()
        kept = going.to(gradient.device)
        self.descent.step(active[going], found.loss[going], gradient[kept], learning_rate=learning_rate)
        self.active = active[going]
        return loss, norm, {**found.seconds, "optimizer": time.perf_counter() - start}, found.memory

    def improved(self, tolerance: float) -> bool:
        """Whether any world's best loss fell by this share since it last did."""
        known = torch.isfinite(self.reference)
        limit = torch.where(known, self.reference - tolerance * self.reference.abs(), self.reference)
        better = self.best_loss < limit
        self.reference = torch.where(better, self.best_loss, self.reference)
        return bool(better.any())

    def _worlds(self) -> State:
        """The active worlds of the state."""
        index = self.active.to(self.state.position.device)
        return self.state if len(self.active) == self.state.batch_size else self.state.map(lambda tensor: tensor[index])

    def _keep_best(self, loss: Tensor, tried: Tensor, ends: Tensor) -> None:
        better = torch.isfinite(loss) & (loss < self.best_loss)
        self.best_loss = torch.where(better, loss, self.best_loss)
        self.best_actions[better.to(tried.device)] = tried[better[self.active].to(tried.device)]
        self.best_ends[better.to(ends.device)] = ends[better[self.active].to(ends.device)]


def _with_rest(found: Evaluation, rest_steps: int) -> Tensor:
    """The gradient (b, T, A), zero where the tools rest."""
    if found.gradient is None:
        raise ValueError("a descent needs an evaluator with gradient")
    found.gradient[:, found.gradient.shape[1] - rest_steps :] = 0.0
    return found.gradient
