"""The extent and the surface of a tool, for collision tests."""

from __future__ import annotations

import torch
from torch import Tensor

from cpdeform.core.clearance import tool_half_extents
from cpdeform.core.rotation import rotate
from cpdeform.core.scene import Tool, ToolMesh
from cpdeform.core.shapes.tool import shape_of
from cpdeform.core.signed_distance import local_distance


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
