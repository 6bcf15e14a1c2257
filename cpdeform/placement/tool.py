"""The extent and the surface of a tool, for collision tests."""

from __future__ import annotations

import torch
from torch import Tensor

from cpdeform.core.errors import InputError
from cpdeform.core.rotation import rotate
from cpdeform.core.scene import (
    Manipulator,
    ManipulatorBox,
    ManipulatorChopsticks,
    ManipulatorCylinder,
    ManipulatorRod,
    ManipulatorSphere,
    ManipulatorTorus,
)
from cpdeform.core.signed_distance import local_distance


def tool_half_extents(manipulator: Manipulator, quaternion: Tensor) -> Tensor:
    """Half edges of the axis-aligned box around a rotated tool.

    Args:
        manipulator: The tool.
        quaternion: Its rotation (4,), unit quaternion wxyz.

    Returns:
        Half edges (3,) along the world's axes, length units.
    """
    axes = rotate(quaternion, torch.eye(3, dtype=quaternion.dtype, device=quaternion.device)).T.abs()
    # A disc's half width along a world axis is its radius times the sine of the angle between that axis and the disc's own.
    along, across = axes[:, 1], (1.0 - axes[:, 1] ** 2).clamp(min=0.0).sqrt()
    match manipulator:
        case ManipulatorSphere():
            return torch.full_like(along, manipulator.radius)
        case ManipulatorRod():
            return along * (0.5 * manipulator.height) + manipulator.radius
        case ManipulatorChopsticks():
            return axes @ torch.tensor([0.5 * manipulator.gap, manipulator.height, 0.0]).to(axes) + manipulator.radius
        case ManipulatorBox():
            return axes @ torch.tensor(manipulator.half_extents).to(axes) + manipulator.rounding
        case ManipulatorCylinder():
            return along * manipulator.half_height + across * manipulator.radius
        case ManipulatorTorus():
            return across * manipulator.major_radius + manipulator.tube_radius
    raise InputError("manipulator", came=type(manipulator).__name__, expected="a manipulator of cpdeform.core.scene")


def surface_points(manipulator: Manipulator, *, resolution: int = 12) -> Tensor:
    """Points all over a tool's surface: a lattice around the tool, each point moved by its distance to the surface.

    Args:
        manipulator: The tool.
        resolution: Lattice points along each axis.

    Returns:
        Points (P, 3) in the tool's local frame, float64, length units, P at most resolution^3.
    """
    identity = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=torch.float64)
    half = 1.1 * tool_half_extents(manipulator, identity)
    lattice = torch.cartesian_prod(*(torch.linspace(-float(edge), float(edge), resolution, dtype=torch.float64) for edge in half))
    # The gradient of a signed distance has length 1, so one step along it lands on the surface, except from medial points.
    points = lattice.requires_grad_()
    with torch.enable_grad():
        distance = local_distance(manipulator, *points.unbind(-1))
        (gradient,) = torch.autograd.grad(distance.sum(), points)
    points = (points - distance.unsqueeze(-1) * gradient).detach()
    landed = local_distance(manipulator, *points.unbind(-1)).abs() < 1e-9
    return points[landed]


def placed_surface(manipulator: Manipulator, pose: Tensor) -> Tensor:
    """Points (P, 3) all over the surface of a tool with the given pose (8,), world frame, length units."""
    return rotate(pose[3:7], surface_points(manipulator, resolution=24).to(pose)) + pose[:3]
