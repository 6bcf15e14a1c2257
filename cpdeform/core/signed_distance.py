"""Signed distances to the tools' surfaces, vectorised and differentiable with finite gradients everywhere.

Where a distance has no gradient (a capsule's axis, the centre of a sphere, a box's medial planes) autograd returns one
element of the subdifferential, of length at most 1, never nan or infinity.
"""

from __future__ import annotations

from torch import Tensor

from cpdeform.core.errors import InputError
from cpdeform.core.rotation import rotate_inverse
from cpdeform.core.scene import Tool
from cpdeform.core.shapes.tool import shape_of

POSE_SIZE = 8
"""Numbers of a tool's pose: position (3), unit quaternion wxyz (4), gap (1); see `State.tool_pose`."""


def signed_distance(tool: Tool, pose: Tensor, points: Tensor) -> Tensor:
    """Distance of points to a tool's surface, negative inside the tool.

    Args:
        tool: The tool; only its shape counts, not its start pose.
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
    return local_distance(tool, *local.unbind(-1), gap=pose[..., None, 7])


def local_distance(tool: Tool, x: Tensor, y: Tensor, z: Tensor, *, gap: Tensor | float | None = None) -> Tensor:
    """Signed distance (...) of points given by their coordinates x, y, z (...) in the tool's local frame, length units.

    The `gap` between chopsticks defaults to the tool's start gap.

    Raises:
        InputError: `tool` is no tool.
    """
    return shape_of(tool, gap=gap).distance(x, y, z)
