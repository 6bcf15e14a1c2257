"""The paper's objective: transport cost between the final particles and the goal."""

from __future__ import annotations

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


class ObjectiveTransport(Objective):
    """Transport cost of each world's final particles against the goal, optionally with PlasticineLab's contact term.

    The gradient is the solver's own, placed at the last step. Within a stage every world starts from its previous
    solution where the solver declares `warm_start`: particles move little between iterations of an optimiser.

    Args:
        solver: Solves the transport problems.
        target: Goal particles (M, 3), length units.
        points: Solve on a fixed random subset of this many source and target particles; all of them where absent. A cloud
            of fewer particles is used whole. Clouds of equal size share the subset, so that particles that correspond stay
            together.
        seed: Seed of the subset.
        warm_start: Whether to start from the previous call's solution, and the first call after `begin` from that of the start.
        refresh: Solve from scratch on each `refresh`-th call, since errors of warm starts accumulate; never where absent.
        contact_weight: Weight of the hard contact term, summed over the steps t = 1..T, cost units/length^2. It attracts
            tools that do not touch the body yet, from which the transport cost alone has no gradient.
        coast_steps: Environment steps for which the particles are taken to go on as fast as in the last one. The loss then is the
            cost plus the mean distance that they would go. For p = 1 this bounds the cost after these steps from above, so that a
            shape which is right only in passing, at speed, is no minimum.
        axis_scale: Factors of the coordinates x, y, z, dimensionless, before distances are taken. With (1, 4, 1) errors of height
            count four times: clay that was raised may never come down again, so that a rise costs more than its distance.
        scene: Whose tools the contact term is about; required with a `contact_weight`.

    Raises:
        InputError: The target is not (M, 3), or an option is out of range.

    References:
        Li et al., "Contact Points Discovery for Soft-Body Manipulations with Differentiable Physics", ICLR 2022.
    """

    def __init__(
        self,
        solver: OTSolver,
        target: Tensor,
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
        if target.ndim != 2 or target.shape[1] != 3 or target.shape[0] == 0:
            raise InputError("target", came=f"shape {tuple(target.shape)}", expected="shape (points, 3) with at least one point")
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
        self.solver, self.target, self.points, self.seed = solver, target.detach(), points, seed
        self.warm_start, self.refresh = warm_start and solver.capabilities.warm_start, refresh
        self.contact_weight, self.coast_steps, self.scene = contact_weight, coast_steps, scene
        self._scale = torch.tensor(axis_scale, dtype=torch.float64)
        self._previous: list[OTResult] = []
        self._start: OTResult | None = None
        self._start_cloud: Tensor | None = None
        self._calls = 0

    def begin(self, start: Trajectory) -> ObjectiveResult:
        """Evaluate a single world from scratch; its solution is where the first evaluation of each batch starts from.

        Where the call before was about the same particles, as at the end of a stage and the beginning of the next, its solution is
        taken again.
        """
        cloud = start.positions[0, -1].detach()
        known = self._start_cloud is not None and torch.equal(cloud, self._start_cloud)
        previous, self._start = self._start if known else None, None
        self.reset()
        result = self._evaluate(start, None if previous is None else [previous])
        self._start, self._start_cloud = (self._previous[0], cloud.clone()) if self._previous else (None, None)
        self.reset()
        return result

    def reset(self) -> None:
        """Forget the solutions kept for warm starts, but that of the stage's start."""
        self._previous = []
        self._calls = 0

    def keep(self, worlds: Sequence[int]) -> None:
        """Forget the solutions of the worlds that were dropped."""
        self._previous = [self._previous[world] for world in worlds] if self._previous else []

    def evaluate(self, trajectory: Trajectory) -> ObjectiveResult:
        """Loss and gradient of each world of a trajectory.

        Raises:
            InputError: A final position is not finite.
        """
        return self._evaluate(trajectory, None)

    def _evaluate(self, trajectory: Trajectory, solutions: list[OTResult] | None) -> ObjectiveResult:
        """As `evaluate`, with the transport problems' solutions where they are known."""
        positions = trajectory.positions.detach()
        loss, gradient = self._transport(positions[:, -1], solutions)
        grad_positions = torch.zeros_like(positions)
        grad_positions[:, -1] = gradient
        if self.coast_steps > 0.0:
            distance, slope = self._coast(positions)
            loss = loss + distance
            grad_positions[:, -1] += slope
            grad_positions[:, -2] -= slope
        grad_poses = None
        if self.contact_weight > 0.0 and self.scene is not None:
            contact, contact_positions, grad_poses = self._contact(self.scene, positions, trajectory.manipulator_poses.detach())
            loss = loss + contact
            grad_positions += contact_positions
        return ObjectiveResult(loss=loss, grad_positions=grad_positions, grad_manipulators=grad_poses)

    def _coast(self, positions: Tensor) -> tuple[Tensor, Tensor]:
        """Mean distance (B,) that particles would still go, and its gradient (B, N, 3) at the last step.

        At the step before that the gradient is the opposite.
        """
        step = positions[:, -1] - positions[:, -2]
        length = (step.square().sum(dim=-1) + COAST_SMOOTHING**2).sqrt()
        scale = self.coast_steps / positions.shape[2]
        return scale * (length - COAST_SMOOTHING).sum(dim=-1), scale * step / length.unsqueeze(-1)

    def _transport(self, final: Tensor, solutions: list[OTResult] | None) -> tuple[Tensor, Tensor]:
        """Cost (B,) and gradient (B, N, 3) of final positions (B, N, 3)."""
        source_index, target_index = (index.to(final.device) for index in self._subsets(final.shape[1]))
        scale = self._scale.to(final)
        clouds, target = scale * final[:, source_index], scale * self.target.to(final)[target_index]
        results = self._solve(clouds, target) if solutions is None else solutions
        self._previous = results if self.warm_start else []
        self._calls += 1
        gradient = torch.zeros_like(final)
        for world, result in enumerate(results):
            gradient[world, source_index] = scale * result.source_gradient.to(final)
        return torch.stack([result.value.to(final) for result in results]), gradient

    def _solve(self, clouds: Tensor, target: Tensor) -> list[OTResult]:
        """Solutions of clouds (B, n, 3) against the target (m, 3), warm-started where that may be."""
        cold = self.refresh is not None and self._calls > 0 and self._calls % self.refresh == 0
        previous: list[OTResult | None] = [None] * len(clouds)
        # A call with another number of worlds is another batch of plans: which world was which is unknown.
        if self.warm_start and not cold and len(self._previous) == len(clouds):
            previous = list(self._previous)
        elif self.warm_start and self._calls == 0:
            previous = [self._start] * len(clouds)
        return [self.solver.solve(cloud, target, previous=start) for cloud, start in zip(clouds, previous, strict=True)]

    def _subsets(self, source_count: int) -> tuple[Tensor, Tensor]:
        """Sorted indices of the source and the target particles that the problem is solved on."""
        target_count = self.target.shape[0]
        source_index = self._subset(source_count, self.seed)
        if target_count == source_count:
            return source_index, source_index
        return source_index, self._subset(target_count, self.seed + 1)

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
