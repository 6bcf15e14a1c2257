"""Gradient descent on action trajectories, all candidate plans at once."""

from __future__ import annotations

import contextlib
import dataclasses
import math
import time
from collections.abc import Callable

import torch
from torch import Tensor

from cpdeform.core.bounded import MOST_COUNT
from cpdeform.core.descent import Descent
from cpdeform.core.errors import InputError
from cpdeform.core.memory import MemoryGauge, MemoryUse
from cpdeform.core.objective import Objective
from cpdeform.core.options import real_number, whole_number
from cpdeform.core.simulator import Simulator, Trajectory
from cpdeform.core.state import State

SCHEDULES = ("halving", "paper")
"""How iterations are shared out among worlds; see `TrajectoryOptimizer.schedule`."""

SEARCH = "search"
"""`Iteration.phase` of the search for a plan."""

LEAST_ITERATIONS = 5
"""No world is dropped before: the first losses are those of tools that have hardly moved."""


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
        phase: ``"search"``, or ``"refinement"`` where the loss is that of `cpdeform.core.refinement.Refinement`.
    """

    index: int
    count: int
    loss: Tensor
    best_loss: Tensor
    seconds: dict[str, float]
    memory: MemoryUse | None = None
    phase: str = SEARCH


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
        schedule: ``"halving"`` drops the worse half of a batch's worlds again and again, so that a single one is left for the last
            half of the iterations (successive halving [1]_); ``"paper"`` gives all worlds all iterations.
        backtrack: Iterations without a gain after which a world goes back to its best plan, with half the step size, as it does at
            once where its loss is not finite; never where absent. See `cpdeform.core.descent.Descent`.

    References:
        .. [1] Jamieson, Talwalkar, "Non-stochastic Best Arm Identification and Hyperparameter Optimization", AISTATS 2016.
    """

    iterations: int = 40
    learning_rate: float = 0.1
    patience: int = 15
    tolerance: float = 1e-3
    initial_noise: float = 0.01
    schedule: str = "halving"
    backtrack: int | None = 4

    def __post_init__(self) -> None:
        for name in ("iterations", "patience"):
            whole_number(f"optimizer.{name}", getattr(self, name), least=1, most=MOST_COUNT)
        if self.backtrack is not None:
            whole_number("optimizer.backtrack", self.backtrack, least=1, most=MOST_COUNT)
        real_number("optimizer.learning_rate", self.learning_rate, least=1e-12, most=1e15, expected="a positive number")
        for name in ("tolerance", "initial_noise"):
            real_number(f"optimizer.{name}", getattr(self, name), least=0.0, most=1e15, expected="zero or more")
        if self.schedule not in SCHEDULES:
            raise InputError("optimizer.schedule", came=repr(self.schedule), expected=f"one of {', '.join(SCHEDULES)}")

    def initial_actions(self, shape: tuple[int, int, int], generator: torch.Generator) -> Tensor:
        """First actions (B, T, A): small Gaussian noise, clipped to [-1, 1]."""
        return (self.initial_noise * torch.randn(shape, generator=generator)).clamp(-1.0, 1.0)

    def minimize(
        self,
        simulator: Simulator,
        state: State,
        actions: Tensor,
        objective: Objective,
        *,
        rest_steps: int = 0,
        on_iteration: Callable[[Iteration], None] | None = None,
    ) -> OptimizationResult:
        """Minimise the objective over the actions of each world.

        Args:
            simulator: A differentiable backend with room for B worlds.
            state: Start of B worlds.
            actions: First actions (B, T, A).
            objective: The loss; worlds do not influence each other.
            rest_steps: The last steps of T, whose actions are left as they are.
            on_iteration: Called after each iteration.

        Returns:
            The best plan of each world. A world that the schedule drops keeps its best plan so far and stops, as does one whose
            loss or gradient is not finite where it may not go back to a plan before.
        """
        count = state.batch_size
        best_actions = actions.detach().clone().to(state.position)
        descent = Descent(best_actions, backtrack=self.backtrack)
        best_ends = state.position.detach().clone()
        best_loss = torch.full((count,), torch.inf, dtype=torch.float64)
        reference = best_loss.clone()
        finite = torch.ones(count, dtype=torch.bool)
        active, evaluations = torch.arange(count), 0
        history: list[Iteration] = []
        since_improvement = 0
        for index in range(self.iterations):
            gauge = _gauge(simulator) if index == min(1, self.iterations - 1) else None
            tried = descent.actions(active)
            stand_ins = best_ends[active.to(best_ends.device)]
            found, gradient, ends, seconds = _evaluate(simulator, _worlds(state, active), tried, objective, stand_ins, gauge)
            gradient[:, gradient.shape[1] - rest_steps :] = 0.0
            evaluations += len(active)
            loss = torch.full_like(best_loss, torch.nan).index_copy(0, active, found)
            sound = torch.isfinite(found) & torch.isfinite(gradient).flatten(1).all(dim=1).cpu()
            finite[active] &= sound
            going = sound | descent.can_return(active)
            better = torch.isfinite(loss) & (loss < best_loss)
            best_loss = torch.where(better, loss, best_loss)
            best_actions[better.to(tried.device)] = tried[better[active].to(tried.device)]
            best_ends[better.to(ends.device)] = ends[better[active].to(ends.device)]
            start = time.perf_counter()
            kept = going.to(gradient.device)
            descent.step(active[going], found[going], gradient[kept], learning_rate=self.learning_rate)
            seconds["optimizer"] = time.perf_counter() - start
            memory = None if gauge is None else _memory_use(simulator, tried, gauge)
            history.append(Iteration(index, self.iterations, loss, best_loss.clone(), seconds, memory))
            if on_iteration is not None:
                on_iteration(history[-1])
            improved = best_loss < torch.where(torch.isfinite(reference), reference - self.tolerance * reference.abs(), reference)
            reference = torch.where(improved, best_loss, reference)
            since_improvement = 0 if bool(improved.any()) else since_improvement + 1
            survivors = self._survivors(active[going], best_loss, index + 1)
            if since_improvement >= self.patience or not len(survivors):
                break
            if len(survivors) < len(active):
                objective.keep([active.tolist().index(world) for world in survivors.tolist()])
                active = survivors
        return OptimizationResult(best_actions, best_loss, finite, evaluations, tuple(history))

    def _survivors(self, active: Tensor, best_loss: Tensor, done: int) -> Tensor:
        """Which worlds go on after `done` iterations, in order."""
        if self.schedule == "paper" or len(active) < 2:
            return active
        rounds = math.ceil(math.log2(len(best_loss)))
        # after 1/2^rounds of the iterations half of the worlds go, ..., after half of them all but one
        passed = sum(done >= max(self.iterations / 2**rung, LEAST_ITERATIONS) for rung in range(1, rounds + 1))
        room = max(1, math.ceil(len(best_loss) / 2**passed))
        return active[best_loss[active].argsort(stable=True)[:room]].sort().values


def _worlds(state: State, active: Tensor) -> State:
    """The active worlds of a state."""
    index = active.to(state.position.device)
    return state if len(active) == state.batch_size else state.map(lambda tensor: tensor[index])


def _gauge(simulator: Simulator) -> MemoryGauge:
    simulator.release_memory()
    return MemoryGauge(simulator.device)


def _memory_use(simulator: Simulator, actions: Tensor, gauge: MemoryGauge) -> MemoryUse:
    worlds, steps = actions.shape[:2]
    return MemoryUse(worlds, simulator.memory_estimate(steps, worlds=worlds), gauge.peak() if gauge.exact else None)


def _evaluate(
    simulator: Simulator, state: State, actions: Tensor, objective: Objective, stand_ins: Tensor, gauge: MemoryGauge | None
) -> tuple[Tensor, Tensor, Tensor, dict[str, float]]:
    """One evaluation; a gauge leaves out the objective.

    Returns:
        Loss (B,) in float64 on the CPU, gradient (B, T, A), the particles' final positions (B, N, 3) and wall times. The objective
        is asked about `stand_ins` (B, N, 3) where a world's rollout is not finite.
    """
    marks = [time.perf_counter()]
    trajectory = simulator.rollout(state, actions)
    finite = torch.isfinite(trajectory.positions).flatten(1).all(dim=1)
    marks.append(time.perf_counter())
    with contextlib.nullcontext() if gauge is None else gauge.leave_out():
        result = objective.evaluate(trajectory if bool(finite.all()) else _held(trajectory, stand_ins, finite))
    marks.append(time.perf_counter())
    gradient = simulator.vjp(trajectory, result.grad_positions, result.grad_manipulators).actions
    marks.append(time.perf_counter())
    loss = torch.where(finite, result.loss.detach().double(), torch.nan).cpu()
    names = ("rollout", "objective", "vjp")
    ends = trajectory.positions[:, -1].detach().clone()
    return loss, gradient, ends, {name: marks[i + 1] - marks[i] for i, name in enumerate(names)}


def _held(trajectory: Trajectory, stand_ins: Tensor, finite: Tensor) -> Trajectory:
    """The trajectory with worlds that broke held where their best plan ends: an objective cannot be asked about nan.

    They go on from that plan, and so does what the objective keeps for warm starts.
    """
    held = stand_ins.unsqueeze(1).expand_as(trajectory.positions)
    positions = torch.where(finite[:, None, None, None], trajectory.positions, held)
    return dataclasses.replace(trajectory, positions=positions, manipulator_poses=trajectory.manipulator_poses.nan_to_num())
