"""Signed distances to the tools' surfaces, vectorised and differentiable with finite gradients everywhere.

Where a distance has no gradient (a capsule's axis, the centre of a sphere, a box's medial planes) autograd returns one
element of the subdifferential, of length at most 1, never nan or infinity.
"""

from __future__ import annotations

from functools import reduce

import torch
from torch import Tensor

from cpdeform.core.errors import InputError
from cpdeform.core.rotation import rotate_inverse
from cpdeform.core.scene import (
    Manipulator,
    ManipulatorBox,
    ManipulatorChopsticks,
    ManipulatorCylinder,
    ManipulatorRod,
    ManipulatorSphere,
    ManipulatorTorus,
)

POSE_SIZE = 8
"""Numbers of a tool's pose: position (3), unit quaternion wxyz (4), gap (1); see `State.manipulator_pose`."""


def signed_distance(manipulator: Manipulator, pose: Tensor, points: Tensor) -> Tensor:
    """Distance of points to a tool's surface, negative inside the tool.

    Args:
        manipulator: The tool; only its shape counts, not its start pose.
        pose: Tool poses (..., 8): position (length units), unit quaternion wxyz, gap (Chopsticks).
        points: Points (..., P, 3), length units; the leading axes broadcast with those of `pose`.

    Returns:
        Signed distances (..., P), length units.

    Raises:
        InputError: The last axis of `pose` is not 8 long or that of `points` not 3.
    """
    if pose.shape[-1:] != (POSE_SIZE,):
        raise InputError("pose", came=f"shape {tuple(pose.shape)}", expected=f"shape (..., {POSE_SIZE})")
    if points.ndim < 2 or points.shape[-1] != 3:
        raise InputError("points", came=f"shape {tuple(points.shape)}", expected="shape (..., points, 3)")
    local = rotate_inverse(pose[..., None, 3:7], points - pose[..., None, :3])
    return local_distance(manipulator, *local.unbind(-1), gap=pose[..., None, 7])


def local_distance(manipulator: Manipulator, x: Tensor, y: Tensor, z: Tensor, *, gap: Tensor | float | None = None) -> Tensor:
    """Signed distance (...) of points given by their coordinates x, y, z (...) in the tool's local frame, length units.

    The `gap` between chopsticks is the tool's start gap where absent.
    """
    match manipulator:
        case ManipulatorSphere():
            return _length(x, y, z) - manipulator.radius
        case ManipulatorRod():
            return _segment_distance(x, y, z, 0.5 * manipulator.height) - manipulator.radius
        case ManipulatorChopsticks():
            half = 0.5 * manipulator.height
            aside = x.abs() - 0.5 * (manipulator.gap if gap is None else gap)
            return _segment_distance(aside, y + half, z, half) - manipulator.radius
        case ManipulatorBox():
            outside = [axis.abs() - half for axis, half in zip((x, y, z), manipulator.half_extents, strict=True)]
            return _corner_distance(*outside) - manipulator.rounding
        case ManipulatorCylinder():
            return _corner_distance(_length(x, z) - manipulator.radius, y.abs() - manipulator.half_height)
        case ManipulatorTorus():
            return _length(_length(x, z) - manipulator.major_radius, y) - manipulator.tube_radius
    raise InputError("manipulator", came=type(manipulator).__name__, expected="a manipulator of cpdeform.core.scene")


def _segment_distance(x: Tensor, y: Tensor, z: Tensor, half: float) -> Tensor:
    """Distance to the segment y in [-half, half]."""
    return _length(x, y - y.clamp(-half, half), z)


def _length(*components: Tensor) -> Tensor:
    """Euclidean length; its gradient at zero is zero, where that of a plain square root is nan."""
    squared = reduce(torch.add, (component * component for component in components))
    if not squared.requires_grad:
        return squared.sqrt()
    positive = squared > 0.0
    root = torch.where(positive, squared, torch.ones_like(squared)).sqrt()
    return torch.where(positive, root, torch.zeros_like(root))


def _corner_distance(*excess: Tensor) -> Tensor:
    """Distance to the set where every component of `excess`, each a distance to one pair of faces, is negative."""
    outside = _length(*(component.clamp(min=0.0) for component in excess))
    return outside + reduce(torch.maximum, excess).clamp(max=0.0)
