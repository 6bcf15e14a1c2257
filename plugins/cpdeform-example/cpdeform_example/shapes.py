"""The surfaces of the tools: signed distances and outward normals."""

from __future__ import annotations

import torch
from torch import Tensor

from cpdeform.core.errors import InputError
from cpdeform.core.scene import (
    Tool,
    ToolBox,
    ToolChopsticks,
    ToolCylinder,
    ToolRod,
    ToolSphere,
    ToolTorus,
)

LENGTH_REGULARIZATION = 1e-8
"""Added to squared lengths (PlasticineLab's quirk). It keeps the gradient at zero finite, and it is part of the model: the
distances of `cpdeform.core.signed_distance`, made for placing tools, do without and differ by about 1e-7."""

TOOL_KINDS = ("Sphere", "Capsule", "Box", "Cylinder", "Torus", "RollingPin", "Chopsticks")


def distance_and_normal(tool: Tool, local: Tensor, gap: Tensor) -> tuple[Tensor, Tensor]:
    """A tool's surface as points see it.

    The normals are written out instead of left to autograd: they are differentiated once more, and at an edge that two faces
    share they choose one face, as the other backends do.

    Args:
        tool: The tool; only its shape counts.
        local: Points (K, 3) in its frame, length units.
        gap: Gap (K, 1) of the tool, where it has one; length units.

    Returns:
        Signed distances (K, 1), negative inside, and outward unit normals (K, 3).

    Raises:
        InputError: The kind is not one of `TOOL_KINDS`.
    """
    match tool:
        case ToolSphere():
            return _around(local, tool.radius)
        case ToolRod():
            return _rod(tool, local)
        case ToolChopsticks():
            aside = 0.5 * gap * _sign(local[:, :1])
            centre = torch.cat([aside, torch.full_like(gap, -0.5 * tool.height), torch.zeros_like(gap)], dim=-1)
            return _rod(tool, local - centre)
        case ToolBox():
            return _box(tool, local)
        case ToolCylinder():
            return _cylinder(tool, local)
        case ToolTorus():
            radial, radius = _radial(local)
            height = local * local.new_tensor([0.0, 1.0, 0.0])
            return _around((radius - tool.major_radius) * radial + height, tool.tube_radius)
    raise InputError("tool", came=type(tool).__name__, expected=f"one of the kinds {', '.join(TOOL_KINDS)}")


def _around(offset: Tensor, radius: float) -> tuple[Tensor, Tensor]:
    """Distance and normal of a surface `radius` around a core, from the offset (K, 3) from the core's nearest point."""
    length = (offset.square().sum(dim=-1, keepdim=True) + LENGTH_REGULARIZATION).sqrt()
    return length - radius, offset / length


def _rod(tool: ToolRod | ToolChopsticks, local: Tensor) -> tuple[Tensor, Tensor]:
    half = 0.5 * tool.height
    x, y, z = local.unbind(-1)
    return _around(torch.stack([x, y - y.clamp(-half, half), z], dim=-1), tool.radius)


def _box(tool: ToolBox, local: Tensor) -> tuple[Tensor, Tensor]:
    half = local.new_tensor(tool.half_extents)
    excess = local.abs() - half
    nearest, axis = excess.max(dim=-1, keepdim=True)
    outside = nearest > 0.0
    # the `where` in front of the square root keeps its infinite slope at zero out of the branch that is not taken
    offset = torch.where(outside, local - local.clamp(-half, half), 1.0)
    length = offset.square().sum(dim=-1, keepdim=True).sqrt()
    face = torch.zeros_like(local).scatter(-1, axis, _sign(local.gather(-1, axis)))
    distance = torch.where(outside, length, nearest)
    return distance - tool.rounding, torch.where(outside, offset / length, face)


def _cylinder(tool: ToolCylinder, local: Tensor) -> tuple[Tensor, Tensor]:
    radial, radius = _radial(local)
    height = local[:, 1:2]
    up = torch.cat([torch.zeros_like(height), _sign(height), torch.zeros_like(height)], dim=-1)
    side, top = radius - tool.radius, height.abs() - tool.half_height
    corner = (side > 0.0) & (top > 0.0)
    length = torch.where(corner, side.square() + top.square(), 1.0).sqrt()
    face = torch.where(side > top, radial, up)
    distance = torch.where(corner, length, torch.where(side > top, side, top))
    return distance, torch.where(corner, (side * radial + top * up) / length, face)


def _radial(local: Tensor) -> tuple[Tensor, Tensor]:
    """Unit vectors (K, 3) away from the y axis, and the distances (K, 1) from it."""
    flat = local * local.new_tensor([1.0, 0.0, 1.0])
    radius = (flat.square().sum(dim=-1, keepdim=True) + LENGTH_REGULARIZATION).sqrt()
    return flat / radius, radius


def _sign(x: Tensor) -> Tensor:
    """-1 or 1, the latter at zero."""
    return torch.where(x < 0.0, -1.0, 1.0).to(x)
