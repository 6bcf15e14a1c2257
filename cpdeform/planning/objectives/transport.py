"""The paper's objective: transport cost between the final particles and the goal."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Sequence

import torch
from torch import Tensor

from cpdeform.core.errors import InputError
from cpdeform.core.objective import Objective, ObjectiveResult
from cpdeform.core.ot import OTResult, OTSolver
from cpdeform.core.scene import Scene
from cpdeform.core.simulator import Trajectory
from cpdeform.planning.objectives.contact import contact_loss

COAST_SMOOTHING = 1e-5
"""Distance per step, length units, below which the coasting term is smooth instead of proportional."""


@dataclasses.dataclass(frozen=True)
class _Warm:
    """What the next evaluation of a world can start from.

    Attributes:
        result: The solution of the last evaluation.
        calls: Evaluations since the one from scratch that the chain began with.
        cloud: Final positions (N, 3) of a solution from scratch; None of others.
    """

    result: OTResult
    calls: int
    cloud: Tensor | None = None

    def is_of(self, cloud: Tensor) -> bool:
        return self.cloud is not None and torch.equal(self.cloud, cloud)


class ObjectiveTransport(Objective):
    """Transport cost of each world's final particles against the goal, optionally with PlasticineLab's contact term.

    The gradient is the solver's own, placed at the last step. Where the solver declares `warm_start`, a world's solution goes into
    `ObjectiveResult.warm` and the next evaluation may start from it: particles move little between iterations of an optimiser.

    Args:
        solver: Solves the transport problems.
        goal: Goal particles (M, 3), length units.
        points: Solve on a fixed random subset of this many source and goal particles; defaults to all of them. A cloud
            of fewer particles is used whole. Clouds of equal size share the subset, so that particles that correspond stay
            together.
        seed: Seed of the subset.
        warm_start: Whether to offer and to use warm starts.
        refresh: Solve from scratch on each `refresh`-th call of a chain of warm starts, since their errors accumulate; None for
            never.
        contact_weight: Weight of the hard contact term, summed over the steps t = 1..T, cost units/length^2. It attracts
            tools that do not touch the body yet, from which the transport cost alone has no gradient.
        coast_steps: Environment steps for which the particles are taken to go on as fast as in the last one. The loss then is the
            cost plus the mean distance that they would go. For p = 1 this bounds the cost after these steps from above, so that a
            shape which is right only in passing, at speed, is no minimum.
        axis_scale: Factors of the coordinates x, y, z, dimensionless, before distances are taken. With (1, 4, 1) errors of height
            count four times: clay that was raised may never come down again, so that a rise costs more than its distance.
        scene: Whose tools the contact term is about; required with a `contact_weight`.

    Raises:
        InputError: The goal is not (M, 3), or an option is out of range.

    References:
        Li et al., "Contact Points Discovery for Soft-Body Manipulations with Differentiable Physics", ICLR 2022.
    """

    def __init__(
        self,
        solver: OTSolver,
        goal: Tensor,
        *,
        points: int | None = None,
        seed: int = 0,
        warm_start: bool = True,
        refresh: int | None = None,
        contact_weight: float = 0.0,
        coast_steps: float = 0.0,
        axis_scale: tuple[float, float, float] = (1.0, 1.0, 1.0),
        scene: Scene | None = None,
    ) -> None:
        if goal.ndim != 2 or goal.shape[1] != 3 or goal.shape[0] == 0:
            raise InputError("goal", came=f"shape {tuple(goal.shape)}", expected="shape (points, 3) with at least one point")
        for name, number in (("points", points), ("refresh", refresh)):
            if number is not None and number < 1:
                raise InputError(name, came=str(number), expected="at least 1, or None")
        for name, value in (("contact_weight", contact_weight), ("coast_steps", coast_steps)):
            if not 0.0 <= value < float("inf"):
                raise InputError(name, came=str(value), expected="a finite number of at least 0")
        if len(axis_scale) != 3 or not all(0.0 < factor < float("inf") for factor in axis_scale):
            raise InputError("axis_scale", came=str(axis_scale), expected="three positive finite numbers")
        if contact_weight > 0.0 and scene is None:
            raise InputError("scene", came="None", expected="the scene", remedy="The contact term needs the shapes of its tools.")
        self.solver, self.goal, self.points, self.seed = solver, goal.detach(), points, seed
        self.warm_start, self.refresh = warm_start and solver.capabilities.warm_start, refresh
        self.contact_weight, self.coast_steps, self.scene = contact_weight, coast_steps, scene
        self._scale = torch.tensor(axis_scale, dtype=torch.float64)

    def evaluate(self, trajectory: Trajectory, warm: Sequence[object] | None = None) -> ObjectiveResult:
        """Loss and gradient of each world of a trajectory.

        Without `warm`, the transport problems are solved from scratch. An entry made that way serves as the start of any world
        nearby; for the very same particles, as at the end of a stage and the beginning of the next, its solution is taken again.

        Raises:
            InputError: A final position is not finite, or `warm` is not what an earlier result held.
        """
        positions = trajectory.positions.detach()
        loss, gradient, entries = self._transport(positions[:, -1], self._entries(warm, len(positions)))
        grad_positions = torch.zeros_like(positions)
        grad_positions[:, -1] = gradient
        if self.coast_steps > 0.0:
            distance, slope = self._coast(positions)
            loss = loss + distance
            grad_positions[:, -1] += slope
            grad_positions[:, -2] -= slope
        grad_poses = None
        if self.contact_weight > 0.0 and self.scene is not None:
            contact, contact_positions, grad_poses = self._contact(self.scene, positions, trajectory.tool_poses.detach())
            loss = loss + contact
            grad_positions += contact_positions
        return ObjectiveResult(loss, grad_positions, grad_poses, warm=entries if self.warm_start else None)

    def with_goal(self, goal: Tensor) -> ObjectiveTransport:
        """The same objective for other goal particles (M, 3), length units."""
        changed = copy.copy(self)
        changed.goal = goal.detach()
        return changed

    def value(self, positions: Tensor) -> Tensor:
        """Transport cost (scalar tensor) of positions (N, 3), length units, from scratch and without further terms."""
        cost, _, _ = self._transport(positions.unsqueeze(0), None)
        return cost[0]

    def _entries(self, warm: Sequence[object] | None, worlds: int) -> list[_Warm] | None:
        """The warm entries, checked; None for a start from scratch."""
        if warm is None or not self.warm_start:
            return None
        entries = [entry for entry in warm if isinstance(entry, _Warm)]
        if len(entries) != worlds or len(warm) != worlds:
            raise InputError("warm", came=f"{len(warm)} entries", expected=f"{worlds} of an earlier result of this objective")
        return entries

    def _coast(self, positions: Tensor) -> tuple[Tensor, Tensor]:
        """Mean distance (B,) that particles would still go, and its gradient (B, N, 3) at the last step.

        At the step before that the gradient is the opposite.
        """
        step = positions[:, -1] - positions[:, -2]
        length = (step.square().sum(dim=-1) + COAST_SMOOTHING**2).sqrt()
        scale = self.coast_steps / positions.shape[2]
        return scale * (length - COAST_SMOOTHING).sum(dim=-1), scale * step / length.unsqueeze(-1)

    def _transport(self, final: Tensor, warm: list[_Warm] | None) -> tuple[Tensor, Tensor, tuple[_Warm, ...]]:
        """Cost (B,) and gradient (B, N, 3) of final positions (B, N, 3), and what the next evaluation can start from."""
        source_index, goal_index = (index.to(final.device) for index in self._subsets(final.shape[1]))
        scale = self._scale.to(final)
        clouds, goal = scale * final[:, source_index], scale * self.goal.to(final)[goal_index]
        known = [entry.result for entry, cloud in zip(warm, final, strict=True) if entry.is_of(cloud)] if warm else []
        if warm is not None and len(known) == len(final):
            results, entries = known, tuple(warm)
        else:
            results, entries = self._solve(clouds, goal, final, warm)
        gradient = torch.zeros_like(final)
        for world, result in enumerate(results):
            gradient[world, source_index] = scale * result.source_gradient.to(final)
        return torch.stack([result.value.to(final) for result in results]), gradient, entries

    def _solve(
        self, clouds: Tensor, goal: Tensor, final: Tensor, warm: list[_Warm] | None
    ) -> tuple[list[OTResult], tuple[_Warm, ...]]:
        """Solutions of clouds (B, n, 3) against the goal (m, 3), warm-started where that may be."""
        if warm is None:
            results = self.solver.solve_batch(clouds, goal)
            return results, tuple(_Warm(result, 0, cloud.clone()) for result, cloud in zip(results, final, strict=True))
        due = [self.refresh is not None and entry.calls > 0 and entry.calls % self.refresh == 0 for entry in warm]
        previous = [None if cold else entry.result for cold, entry in zip(due, warm, strict=True)]
        results = self.solver.solve_batch(clouds, goal, previous=previous)
        return results, tuple(_Warm(result, entry.calls + 1) for result, entry in zip(results, warm, strict=True))

    def _subsets(self, source_count: int) -> tuple[Tensor, Tensor]:
        """Sorted indices of the source and the goal particles that the problem is solved on."""
        goal_count = self.goal.shape[0]
        source_index = self._subset(source_count, self.seed)
        if goal_count == source_count:
            return source_index, source_index
        return source_index, self._subset(goal_count, self.seed + 1)

    def _subset(self, count: int, seed: int) -> Tensor:
        if self.points is None or self.points >= count:
            return torch.arange(count)
        generator = torch.Generator().manual_seed(seed)
        return torch.randperm(count, generator=generator)[: self.points].sort().values

    def _contact(self, scene: Scene, positions: Tensor, poses: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Weighted contact term (B,) and its gradient with respect to positions and tool poses."""
        positions, poses = positions.requires_grad_(), poses.requires_grad_()
        with torch.enable_grad():
            terms = contact_loss(scene, positions[:, 1:], poses[:, 1:], kind="hard").sum(dim=1)
            loss = self.contact_weight * terms
            if not loss.requires_grad:
                return loss, torch.zeros_like(positions), torch.zeros_like(poses)
            grad_positions, grad_poses = torch.autograd.grad(loss.sum(), [positions, poses])
        return loss.detach(), grad_positions, grad_poses
