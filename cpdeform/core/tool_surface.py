"""The surfaces of tools as points, and how far these are from other tools."""

from __future__ import annotations

import torch
from torch import Tensor

from cpdeform.core.clearance import tool_half_extents
from cpdeform.core.rotation import rotate
from cpdeform.core.scene import Scene, Tool, ToolMesh
from cpdeform.core.shapes.tool import shape_of
from cpdeform.core.signed_distance import local_distance, signed_distance
from cpdeform.core.state import tool_pose


def surface_points(tool: Tool, *, resolution: int = 12) -> Tensor:
    """Points all over a tool's surface: a lattice around the tool, each point moved by its distance to the surface.

    Args:
        tool: The tool.
        resolution: Lattice points along each axis.

    Returns:
        Points (P, 3) in the tool's local frame, float64, length units, P at most resolution^3.
    """
    if isinstance(tool, ToolMesh):
        return torch.as_tensor(tool.shape().surface(rows=resolution, columns=resolution).reshape(-1, 3))
    identity = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=torch.float64)
    half = 1.1 * tool_half_extents(tool, identity)
    lattice = torch.cartesian_prod(*(torch.linspace(-float(edge), float(edge), resolution, dtype=torch.float64) for edge in half))
    # The gradient of a signed distance has length 1, so one step along it lands on the surface, except from medial points.
    distance, gradient = shape_of(tool).distance_and_gradient(lattice)
    points = lattice - distance.unsqueeze(-1) * gradient
    landed = local_distance(tool, *points.unbind(-1)).abs() < 1e-9
    return points[landed]


def placed_surface(tool: Tool, pose: Tensor) -> Tensor:
    """Points (P, 3) all over the surface of a tool with the given pose (8,), world frame, length units."""
    return rotate(pose[3:7], surface_points(tool, resolution=24).to(pose)) + pose[:3]


class ToolSurfaces:
    """Points on the surfaces of a scene's tools, for any number of poses at once; differentiable with respect to these.

    Args:
        scene: Its tools, M of them.
        resolution: See `surface_points`.
    """

    def __init__(self, scene: Scene, *, resolution: int = 12) -> None:
        self._tools, self._start = scene.tools, tool_pose(scene)
        self._points = [surface_points(tool, resolution=resolution) for tool in scene.tools]

    def lowest(self, index: int, poses: Tensor) -> Tensor:
        """Height (...) of the lowest point of one tool, length units, with the poses (..., M, 8) of all tools."""
        return self._placed(index, poses)[..., 1].amin(dim=-1)

    def floors(self, floor: float) -> dict[int, float]:
        """How low each movable tool may reach, length units: to the floor, or as low as the scene itself puts it.

        Args:
            floor: Height of the floor, length units.
        """
        return {index: min(floor, float(self.lowest(index, self._start))) for index, tool in enumerate(self._tools) if tool.movable}

    def gaps(self, index: int, poses: Tensor) -> Tensor:
        """Distance (..., M - 1) of one tool from each of the others, length units, negative where they overlap.

        It is that of the tool's points from the other tool's surface.

        Args:
            index: The tool.
            poses: Poses (..., M, 8) of all tools.
        """
        points = self._placed(index, poses)
        others = [other for other in range(len(self._tools)) if other != index]
        gaps = [signed_distance(self._tools[other], poses[..., other, :], points).amin(dim=-1) for other in others]
        return torch.stack(gaps, dim=-1) if gaps else poses.new_empty(*poses.shape[:-2], 0)

    def _placed(self, index: int, poses: Tensor) -> Tensor:
        """The points (..., P, 3) of a tool, world frame."""
        pose = poses[..., index, None, :]
        return rotate(pose[..., 3:7], self._points[index].to(poses)) + pose[..., :3]
