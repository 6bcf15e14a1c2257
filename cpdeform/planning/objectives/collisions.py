"""What a plan costs that no robot could execute: tools that reach below the floor or into each other."""

from __future__ import annotations

import torch
from torch import Tensor

from cpdeform.core.rotation import rotate
from cpdeform.core.scene import Scene
from cpdeform.core.signed_distance import signed_distance
from cpdeform.core.tool_surface import surface_points

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
        self._scene, self._cell = scene, scene.node_distance
        self._surfaces = [surface_points(tool, resolution=RESOLUTION) for tool in scene.tools]
        self._floors = [floor] * len(scene.tools)
        for index, tool in enumerate(scene.tools):
            start = torch.tensor([*tool.position, *tool.rotation_wxyz], dtype=torch.float64)
            self._floors[index] = min(floor, float(self._placed(index, start)[..., 1].min()))

    def cost(self, tool_poses: Tensor) -> Tensor:
        """Cost (B,) of tool poses (B, T+1, M, 8), summed over the steps in which a tool moves, and the tools; differentiable."""
        total = tool_poses.new_zeros(tool_poses.shape[0])
        for index, tool in enumerate(self._scene.tools):
            if not tool.movable:
                continue
            path = tool_poses[..., index, :]
            moves = (path.detach().diff(dim=1) != 0.0).any(dim=-1)
            points = self._placed(index, path[:, 1:])
            depths = [self._floors[index] - points[..., 1].amin(dim=-1)]
            for other, neighbour in enumerate(self._scene.tools):
                if other != index:
                    depths.append(-signed_distance(neighbour, tool_poses[:, 1:, other], points).amin(dim=-1))
            total = total + (self._of_depths(torch.stack(depths)).sum(dim=0) * moves).sum(dim=-1)
        return total

    def _of_depths(self, depths: Tensor) -> Tensor:
        """Cost of depths, length units; nothing where they are negative."""
        cells = (depths / self._cell).clamp(min=0.0)
        return torch.nn.functional.huber_loss(cells, torch.zeros_like(cells), reduction="none")

    def cost_and_gradient(self, tool_poses: Tensor) -> tuple[Tensor, Tensor]:
        """`cost` (B,) and its gradient (B, T+1, M, 8)."""
        poses = tool_poses.detach().requires_grad_()
        with torch.enable_grad():
            cost = self.cost(poses)
            if not cost.requires_grad:
                return cost.detach(), torch.zeros_like(poses)
            (gradient,) = torch.autograd.grad(cost.sum(), poses)
        return cost.detach(), gradient

    def _placed(self, index: int, pose: Tensor) -> Tensor:
        """Surface points (..., P, 3) of a tool with the poses (..., 7 or more)."""
        return rotate(pose[..., None, 3:7], self._surfaces[index].to(pose)) + pose[..., None, :3]
