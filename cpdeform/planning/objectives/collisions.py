"""What a plan costs that no robot could execute: tools that reach below the floor or into each other."""

from __future__ import annotations

import torch
from torch import Tensor

from cpdeform.core.scene import Scene
from cpdeform.core.tool_surface import ToolSurfaces

RESOLUTION = 9
"""Points of the lattice along each axis that a tool's surface is sampled by; odd, so that a round tool's poles are among them."""


class ToolCollisions:
    """How deep movable tools reach below the floor and into other tools, summed over a plan's environment steps.

    A tool's surface is a sample of points (`cpdeform.core.tool_surface.surface_points`); its depth d is that of the deepest one, in
    cells of the grid. It costs d^2 / 2 up to a cell and d - 1/2 beyond (Huber [1]_): a steeper cost near zero would drown the rest
    of the gradient in the momentum of a descent wherever a tool slides along the floor. Where the scene itself puts a tool below
    the floor, only what lies deeper counts. A tool that stands still costs nothing: it is taken away before the next stage.

    Args:
        scene: Its tools.
        floor: Height of the floor, length units.

    References:
        .. [1] Huber, "Robust Estimation of a Location Parameter", The Annals of Mathematical Statistics 35 (1964).
    """

    def __init__(self, scene: Scene, *, floor: float) -> None:
        self._cell = scene.node_distance
        self._movable = [index for index, tool in enumerate(scene.tools) if tool.movable]
        self._surfaces = ToolSurfaces(scene, resolution=RESOLUTION)
        self._floors = self._surfaces.floors(floor)

    def cost(self, tool_poses: Tensor) -> Tensor:
        """Cost (B,), dimensionless, of tool poses (B, T+1, M, 8), over the steps in which a tool moves; differentiable."""
        total = tool_poses.new_zeros(tool_poses.shape[0])
        poses = tool_poses[:, 1:]
        for index in self._movable:
            moves = (tool_poses[..., index, :].detach().diff(dim=1) != 0.0).any(dim=-1)
            below = self._of_depths(self._floors[index] - self._surfaces.lowest(index, poses))
            within = self._of_depths(-self._surfaces.gaps(index, poses)).sum(dim=-1)
            total = total + ((below + within) * moves).sum(dim=-1)
        return total

    def _of_depths(self, depths: Tensor) -> Tensor:
        """Cost of depths, length units; nothing where they are negative."""
        cells = (depths / self._cell).clamp(min=0.0)
        return torch.nn.functional.huber_loss(cells, torch.zeros_like(cells), reduction="none")

    def cost_and_gradient(self, tool_poses: Tensor) -> tuple[Tensor, Tensor]:
        """`cost` (B,) and its gradient (B, T+1, M, 8) by the poses."""
        poses = tool_poses.detach().requires_grad_()
        with torch.enable_grad():
            cost = self.cost(poses)
            if not cost.requires_grad:
                return cost.detach(), torch.zeros_like(poses)
            (gradient,) = torch.autograd.grad(cost.sum(), poses)
        return cost.detach(), gradient
