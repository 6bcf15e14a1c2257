"""Gradient descent on action trajectories, all candidate plans at once."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from cpdeform.core.bounded import MOST_COUNT
from cpdeform.core.memory import MemoryUse
from cpdeform.core.objective import Objective
from cpdeform.core.options import real_number, whole_number
from cpdeform.core.simulator import Simulator
from cpdeform.core.state import State
from cpdeform.planning.batches import Evaluator
from cpdeform.planning.effort import Effort
from cpdeform.planning.executor import Executor, ExecutorSerial
from cpdeform.planning.pruner import Pruner, PrunerHalving
from cpdeform.planning.race import Race

SEARCH = "search"
"""Name of the phase that searches for a plan."""


@dataclasses.dataclass(frozen=True)
class Iteration:
    """One gradient evaluation of all worlds.

    Attributes:
        index: Number of the iteration, from 0.
        count: Number of iterations planned.
        loss: Loss (B,) of the actions tried, objective units; nan where the world's rollout was not finite or was not computed
            because the world was dropped.
        best_loss: Lowest loss (B,) so far.
        seconds: Wall time of the parts `rollout`, `objective`, `vjp` and `optimizer`.
        memory: Memory of rollout and gradient; measured in one iteration, after the first if there are several, else None.
        gradient_norm: Euclidean norm (B,) of the gradient by the actions, objective units; nan where there was none. None where
            it is unknown.
        time: When it was done, Unix seconds.
        phase: Name of the phase, e.g. ``"search"``; the losses of another phase may be in another unit.
    """

    index: int
    count: int
    loss: Tensor
    best_loss: Tensor
    seconds: dict[str, float]
    memory: MemoryUse | None = None
    phase: str = SEARCH
    gradient_norm: Tensor | None = None
    time: float = dataclasses.field(default_factory=time.time)


@dataclasses.dataclass(frozen=True)
class OptimizationResult:
    """Plans found by `TrajectoryOptimizer.minimize`.

    Attributes:
        actions: Best actions (B, T, A) of each world, in [-1, 1].
        loss: Their loss (B,), objective units; infinity where no evaluation was finite.
        finite: Worlds (B,) whose every loss and gradient were finite.
        gradient_evaluations: Gradients computed, of all worlds together.
        history: Every iteration, in order.
    """

    actions: Tensor
    loss: Tensor
    finite: Tensor
    gradient_evaluations: int
    history: tuple[Iteration, ...]


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrajectoryOptimizer:
    """Adam on actions clipped to [-1, 1], best plan kept (paper, Algorithm 1).

    Attributes:
        iterations: The most gradient evaluations per world.
        learning_rate: Adam's step size, in units of action.
        patience: Stop when no world improved by `tolerance` for this many iterations.
        tolerance: Smallest relative improvement of the loss that counts.
        initial_noise: Standard deviation of the first actions about zero, so that seeds differ.
        pruner: Which worlds go on after each iteration; see `cpdeform.planning.pruner`.
        backtrack: Iterations without a gain after which a world goes back to its best plan, with half the step size, as it does at
            once where its loss is not finite; None for never. See `cpdeform.planning.descent.Descent`.
        leap: Rise of the loss above the best one, as a share of it, after which a world goes back at once; None for no limit.
        warm_up: Iterations over which the step size grows to `learning_rate`. Adam's first steps are full ones in every action,
            whatever its gradient: together they may undo what a long plan has gained.
        annealed: Whether the step size falls to zero along half a period of a cosine [1]_ in the second half of the iterations.

    References:
        .. [1] Loshchilov, Hutter, "SGDR: Stochastic Gradient Descent with Warm Restarts", ICLR 2017.
    """

    iterations: int = 40
    learning_rate: float = 0.1
    patience: int = 15
    tolerance: float = 1e-3
    initial_noise: float = 0.01
    pruner: Pruner = dataclasses.field(default_factory=PrunerHalving)
    backtrack: int | None = 4
    leap: float | None = None
    warm_up: int = 1
    annealed: bool = False

    def __post_init__(self) -> None:
        for name in ("iterations", "patience", "warm_up"):
            whole_number(f"optimizer.{name}", getattr(self, name), least=1, most=MOST_COUNT)
        if self.backtrack is not None:
            whole_number("optimizer.backtrack", self.backtrack, least=1, most=MOST_COUNT)
        real_number("optimizer.learning_rate", self.learning_rate, least=1e-12, most=1e15, expected="a positive number")
        if self.leap is not None:
            real_number("optimizer.leap", self.leap, least=0.0, most=1e15, expected="zero or more")
        for name in ("tolerance", "initial_noise"):
            real_number(f"optimizer.{name}", getattr(self, name), least=0.0, most=1e15, expected="zero or more")

    def initial_actions(self, shape: tuple[int, int, int], generator: torch.Generator) -> Tensor:
        """First actions (B, T, A): small Gaussian noise, clipped to [-1, 1]."""
        return (self.initial_noise * torch.randn(shape, generator=generator)).clamp(-1.0, 1.0)

    def effort(self, worlds: int) -> Effort:
        """Gradients of a descent: at least those before its patience ends, at most all that the pruner leaves."""
        active, done = torch.arange(worlds), 0
        counts = []
        for index in range(self.iterations):
            done += len(active)
            counts.append(done)
            active = self.pruner.survivors(active, torch.zeros(worlds), done=index + 1, iterations=self.iterations)
        return Effort(gradients=(counts[min(self.patience, self.iterations - 1)], done))

    def _rate(self, index: int) -> float:
        """Step size of an iteration, in units of action."""
        rate = self.learning_rate * min(1.0, (index + 1) / self.warm_up)
        done = 2.0 * index / self.iterations - 1.0
        return rate * (0.5 + 0.5 * math.cos(math.pi * done)) if self.annealed and done > 0.0 else rate

    def minimize(
        self,
        simulator: Simulator,
        state: State,
        actions: Tensor,
        objective: Objective,
        *,
        rest_steps: int = 0,
        warm: Sequence[object] | None = None,
        executor: Executor | None = None,
        on_iteration: Callable[[Iteration], None] | None = None,
        on_start: Callable[[Race], None] | None = None,
    ) -> OptimizationResult:
        """Minimise the objective over the actions of each world.

        Args:
            simulator: A differentiable backend; worlds that it has no room for are evaluated in further batches.
            state: Start of B worlds.
            actions: First actions (B, T, A).
            objective: The loss; worlds do not influence each other.
            rest_steps: The last steps of T, whose actions are left as they are.
            warm: What the objective can start from in the first evaluation of each world, B entries; None for nothing.
            executor: Where batches are computed; defaults to this process.
            on_iteration: Called after each iteration.
            on_start: Called once with the worlds on their way down, which hold the best plans so far at any time.

        Returns:
            The best plan of each world. A world that the pruner drops keeps its best plan so far and stops, as does one whose
            loss or gradient is not finite where it may not go back to a plan before.
        """
        race = Race.begin(state, actions, backtrack=self.backtrack, leap=self.leap, warm=warm)
        if on_start is not None:
            on_start(race)
        evaluator, executor = Evaluator(simulator, objective), executor or ExecutorSerial()
        history: list[Iteration] = []
        since_improvement = 0
        for index in range(self.iterations):
            loss, norm, seconds, memory = race.step(
                evaluator,
                executor,
                rest_steps=rest_steps,
                learning_rate=self._rate(index),
                measured=index == min(1, self.iterations - 1),
            )
            best = race.best_loss.clone()
            history.append(Iteration(index, self.iterations, loss, best, seconds, memory, gradient_norm=norm))
            if on_iteration is not None:
                on_iteration(history[-1])
            since_improvement = 0 if race.improved(self.tolerance) else since_improvement + 1
            survivors = self.pruner.survivors(race.active, race.best_loss, done=index + 1, iterations=self.iterations)
            if since_improvement >= self.patience or not len(survivors):
                break
            race.active = survivors
        return OptimizationResult(race.best_actions, race.best_loss, race.finite, race.evaluations, tuple(history))
