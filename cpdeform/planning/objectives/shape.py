"""Transport for the way, misplaced mass for the shape, and tools that stay free of the floor and of each other."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from cpdeform.core.errors import InputError
from cpdeform.core.objective import Objective, ObjectiveResult
from cpdeform.core.scene import Scene
from cpdeform.core.simulator import Trajectory
from cpdeform.planning.objectives.collisions import ToolCollisions
from cpdeform.planning.objectives.mass import mass_grid
from cpdeform.planning.objectives.transport import ObjectiveTransport

SCALES = (1.0, 0.625, 0.375)
"""Nodes along an edge of the domain of the grids that mass is compared on, as parts of the scene's."""

LEAST_NODES = 8
"""The least nodes of such a grid."""

COLLISION_WEIGHT = 0.02
"""What a tool adds to the loss with each cell that it goes deeper below the floor or into another one, for one environment step."""


class ObjectiveShape(Objective):
    """Transport cost and the share of misplaced mass at several scales, each over its value where the run begins.

    Transport alone leads clay to where it is missing, but hardly minds crumbs and holes. The misplaced share of the mass,
    sum |m - m*| / (2 sum m*) of node masses m and those of the goal m*, sees these, and only these: it looks no farther than a
    node's neighbours, hence the coarser grids. The loss is 1 + `density_weight` at the start and 0 for the goal itself.

    Added to it is `collision_weight` times `cpdeform.planning.objectives.collisions.ToolCollisions.cost`, which no plan has that a
    robot could execute. The floor is the height of the lowest particle at the start.

    Attributes:
        goal: Goal particles (M, 3), length units.
        start: Particles (N, 3) where the run begins, length units.

    Args:
        transport: The transport term.
        scene: Particle mass.
        goal: Goal particles (M, 3), length units.
        start: Particles (N, 3) where the run begins, length units.
        density_weight: Weight of the misplaced mass beside the transport.
        collision_weight: Weight of tools below the floor or inside each other, dimensionless; 0 lets them pass.

    Raises:
        InputError: The start is the goal already, or a weight is negative.
    """

    def __init__(
        self,
        transport: ObjectiveTransport,
        scene: Scene,
        goal: Tensor,
        start: Tensor,
        *,
        density_weight: float = 1.0,
        collision_weight: float = COLLISION_WEIGHT,
    ) -> None:
        for name, weight in (("density_weight", density_weight), ("collision_weight", collision_weight)):
            if not 0.0 <= weight < float("inf"):
                raise InputError(name, came=str(weight), expected="a finite number of at least 0")
        self._transport, self._weight, self._scene = transport, density_weight, scene
        self._collision_weight = collision_weight
        self._collisions = ToolCollisions(scene, floor=float(start[:, 1].min())) if collision_weight else None
        self.goal, self.start = goal.detach(), start.detach()
        self._scenes = [scene.model_copy(update={"grid_size": max(LEAST_NODES, round(part * scene.grid_size))}) for part in SCALES]
        self._goals = [_shares(goal.detach(), scale) for scale in self._scenes]
        cost = float(transport.value(start.detach()))
        self._misplaced_start = float(self._misplaced(start.detach().unsqueeze(0))[0])
        self._cost_start = cost
        if not (cost > 0.0 and self._misplaced_start > 0.0):
            raise InputError("start", came="the goal itself", expected="a shape that differs from the goal")

    def rebased(self, *, goal: Tensor, start: Tensor) -> ObjectiveShape:
        """The same objective for another goal (M, 3) and another start (N, 3), length units, such as those at rest."""
        transport = self._transport.with_goal(goal.to(self._transport.goal))
        weights = {"density_weight": self._weight, "collision_weight": self._collision_weight}
        return ObjectiveShape(transport, self._scene, goal, start, **weights)

    def evaluate(self, trajectory: Trajectory, warm: Sequence[object] | None = None) -> ObjectiveResult:
        """Loss and gradient of each world; the transport term is warm-started."""
        result = self._transport.evaluate(trajectory, warm)
        final = trajectory.positions[:, -1].detach().requires_grad_()
        with torch.enable_grad():
            misplaced = self._misplaced(final)
            (slope,) = torch.autograd.grad(misplaced.sum(), final)
        factor = self._weight / self._misplaced_start
        gradient = result.grad_positions / self._cost_start
        gradient[:, -1] += factor * slope
        loss = result.loss / self._cost_start + factor * misplaced.detach().to(result.loss)
        poses = None if result.grad_tools is None else result.grad_tools / self._cost_start
        if self._collisions is not None:
            collisions, collision_slope = self._collisions.cost_and_gradient(trajectory.tool_poses)
            loss = loss + self._collision_weight * collisions.to(loss)
            if bool(collisions.any()):
                collision_slope = self._collision_weight * collision_slope
                poses = collision_slope if poses is None else poses + collision_slope
        return ObjectiveResult(loss=loss, grad_positions=gradient, grad_tools=poses, warm=result.warm)

    def losses(self, trajectory: Trajectory, warm: Sequence[object] | None = None) -> Tensor:
        """Loss (B,) of each world alone."""
        transport = self._transport.losses(trajectory, warm)
        with torch.no_grad():
            misplaced = self._misplaced(trajectory.positions[:, -1].detach())
            loss = transport / self._cost_start + (self._weight / self._misplaced_start) * misplaced.to(transport)
            if self._collisions is not None:
                loss = loss + self._collision_weight * self._collisions.cost(trajectory.tool_poses.detach()).to(loss)
        return loss

    def _misplaced(self, positions: Tensor) -> Tensor:
        """Misplaced share (B,) of the mass of positions (B, N, 3), the mean over the scales."""
        shares = [
            (_shares(positions, scene) - goal.to(positions)).abs().sum(dim=(-3, -2, -1)) / 2.0
            for scene, goal in zip(self._scenes, self._goals, strict=True)
        ]
        return torch.stack(shares).mean(dim=0)


def _shares(positions: Tensor, scene: Scene) -> Tensor:
    """Node masses (..., G, G, G) of positions (..., N, 3), as shares of the whole."""
    mass = mass_grid(positions, scene)
    return mass / mass.detach().sum(dim=(-3, -2, -1), keepdim=True)
