"""Gradient descent on action trajectories, all candidate plans at once."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable

import torch
from torch import Tensor

from cpdeform.core.errors import InputError
from cpdeform.core.objective import Objective
from cpdeform.core.simulator import Simulator
from cpdeform.core.state import State


@dataclasses.dataclass(frozen=True)
class Iteration:
    """One gradient evaluation of all worlds.

    Attributes:
        index: Number of the iteration, from 0.
        count: Number of iterations planned.
        loss: Loss (B,) of the actions tried, objective units; nan where the world's rollout was not finite.
        best_loss: Lowest loss (B,) so far.
        seconds: Wall time of the parts `rollout`, `objective`, `vjp` and `optimizer`.
    """

    index: int
    count: int
    loss: Tensor
    best_loss: Tensor
    seconds: dict[str, float]


@dataclasses.dataclass(frozen=True)
class OptimizationResult:
    """Plans found by `TrajectoryOptimizer.minimize`.

    Attributes:
        actions: Best actions (B, T, A) of each world, in [-1, 1].
        loss: Their loss (B,), objective units; infinity where no evaluation was finite.
        finite: Worlds (B,) whose every loss and gradient were finite.
        gradient_evaluations: Worlds times iterations evaluated.
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
    """

    iterations: int = 40
    learning_rate: float = 0.1
    patience: int = 15
    tolerance: float = 1e-3
    initial_noise: float = 0.01

    def __post_init__(self) -> None:
        limits = {"iterations": self.iterations >= 1, "learning_rate": self.learning_rate > 0, "patience": self.patience >= 1}
        for name, fine in limits.items():
            if not fine:
                raise InputError(f"optimizer.{name}", came=str(getattr(self, name)), expected="a positive number")
        for name in ("tolerance", "initial_noise"):
            if not getattr(self, name) >= 0:
                raise InputError(f"optimizer.{name}", came=str(getattr(self, name)), expected="zero or more")

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
        on_iteration: Callable[[Iteration], None] | None = None,
    ) -> OptimizationResult:
        """Minimise the objective over the actions of each world.

        Args:
            simulator: A differentiable backend with room for B worlds.
            state: Start of B worlds.
            actions: First actions (B, T, A).
            objective: The loss; worlds do not influence each other.
            on_iteration: Called after each iteration.

        Returns:
            The best plan of each world. A world whose loss or gradient is not finite keeps its best plan so far and stops.
        """
        tried = actions.detach().clone().to(state.position).requires_grad_()
        adam = torch.optim.Adam([tried], lr=self.learning_rate)
        best_actions = tried.detach().clone()
        best_loss = torch.full((state.batch_size,), torch.inf, dtype=torch.float64)
        reference = best_loss.clone()
        alive = torch.ones(state.batch_size, dtype=torch.bool)
        history: list[Iteration] = []
        since_improvement = 0
        for index in range(self.iterations):
            loss, gradient, seconds = _evaluate(simulator, state, tried.detach(), objective)
            alive &= torch.isfinite(loss) & torch.isfinite(gradient).flatten(1).all(dim=1).cpu()
            better = torch.isfinite(loss) & (loss < best_loss)
            best_loss = torch.where(better, loss, best_loss)
            best_actions[better.to(best_actions.device)] = tried.detach()[better.to(tried.device)]
            start = time.perf_counter()
            keep = alive.to(gradient.device)[:, None, None]
            tried.grad = torch.where(keep, gradient, torch.zeros_like(gradient))
            adam.step()
            with torch.no_grad():
                tried.clamp_(-1.0, 1.0)
                tried.copy_(torch.where(keep, tried, best_actions))
            seconds["optimizer"] = time.perf_counter() - start
            history.append(Iteration(index, self.iterations, loss, best_loss.clone(), seconds))
            if on_iteration is not None:
                on_iteration(history[-1])
            improved = best_loss < torch.where(torch.isfinite(reference), reference - self.tolerance * reference.abs(), reference)
            reference = torch.where(improved, best_loss, reference)
            since_improvement = 0 if bool(improved.any()) else since_improvement + 1
            if since_improvement >= self.patience or not bool(alive.any()):
                break
        return OptimizationResult(best_actions, best_loss, alive, state.batch_size * len(history), tuple(history))


def _evaluate(simulator: Simulator, state: State, actions: Tensor, objective: Objective) -> tuple[Tensor, Tensor, dict[str, float]]:
    """Loss (B,) in float64 on the CPU, gradient (B, T, A) and wall times of one evaluation."""
    marks = [time.perf_counter()]
    trajectory = simulator.rollout(state, actions)
    finite = torch.isfinite(trajectory.positions).flatten(1).all(dim=1)
    marks.append(time.perf_counter())
    if not bool(finite.all()):
        # An objective cannot be asked about nan: worlds that broke are held at their start and reported as nan.
        held = state.position.unsqueeze(1).expand_as(trajectory.positions)
        positions = torch.where(finite[:, None, None, None], trajectory.positions, held)
        poses = trajectory.manipulator_poses.nan_to_num()
        result = objective.evaluate(dataclasses.replace(trajectory, positions=positions, manipulator_poses=poses))
    else:
        result = objective.evaluate(trajectory)
    marks.append(time.perf_counter())
    gradient = simulator.vjp(trajectory, result.grad_positions, result.grad_manipulators).actions
    marks.append(time.perf_counter())
    loss = torch.where(finite, result.loss.detach().double(), torch.nan).cpu()
    names = ("rollout", "objective", "vjp")
    return loss, gradient, {name: marks[i + 1] - marks[i] for i, name in enumerate(names)}
