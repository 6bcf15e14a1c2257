"""Unit quaternions (w, x, y, z) as torch functions; all broadcast over leading axes and are differentiable everywhere."""

from __future__ import annotations

import torch
from torch import Tensor

SMALL_ANGLE_SQUARED = 1e-8
"""Below this squared angle (radians^2) the series of sine and cosine replaces them: their own gradient is 0/0 at zero."""


def multiply(left: Tensor, right: Tensor) -> Tensor:
    """Hamilton product of quaternions (..., 4): the rotation `right` first, then `left`."""
    w, x, y, z = left.unbind(-1)
    v, i, j, k = right.unbind(-1)
    return torch.stack(
        [
            w * v - x * i - y * j - z * k,
            w * i + x * v + y * k - z * j,
            w * j - x * k + y * v + z * i,
            w * k + x * j - y * i + z * v,
        ],
        dim=-1,
    )


def conjugate(quaternion: Tensor) -> Tensor:
    """Conjugate of quaternions (..., 4); the inverse rotation where they have unit length."""
    return torch.cat([quaternion[..., :1], -quaternion[..., 1:]], dim=-1)


def rotate(quaternion: Tensor, vectors: Tensor) -> Tensor:
    """Rotate vectors from the local into the world frame.

    Args:
        quaternion: Unit quaternions (..., 4).
        vectors: Vectors (..., 3), any unit; leading axes broadcast with those of `quaternion`.

    Returns:
        Rotated vectors (..., 3), in the unit of `vectors`.
    """
    scalar, axis = quaternion[..., :1], quaternion[..., 1:]
    twice_cross = 2.0 * _cross(axis, vectors)
    return vectors + scalar * twice_cross + _cross(axis, twice_cross)


def _cross(left: Tensor, right: Tensor) -> Tensor:
    """Cross product (..., 3); `torch.linalg.cross` does not broadcast over a missing leading axis."""
    x, y, z = left.unbind(-1)
    i, j, k = right.unbind(-1)
    return torch.stack([y * k - z * j, z * i - x * k, x * j - y * i], dim=-1)


def rotate_inverse(quaternion: Tensor, vectors: Tensor) -> Tensor:
    """Rotate vectors (..., 3) from the world into the local frame of unit quaternions (..., 4)."""
    return rotate(conjugate(quaternion), vectors)


def from_rotation_vector(rotation: Tensor) -> Tensor:
    """Unit quaternions (..., 4) of rotation vectors (..., 3): axis times angle, radians.

    The gradient is finite at the zero vector, where it is (0, 1/2, 1/2, 1/2) per component.
    """
    squared = (rotation * rotation).sum(dim=-1, keepdim=True)
    small = squared < SMALL_ANGLE_SQUARED
    # The inner `where` keeps the branch that is not taken away from sqrt(0), whose infinite slope would become nan.
    angle = torch.where(small, torch.ones_like(squared), squared).sqrt()
    scalar = torch.where(small, 1.0 - squared / 8.0, torch.cos(0.5 * angle))
    factor = torch.where(small, 0.5 - squared / 48.0, torch.sin(0.5 * angle) / angle)
    return torch.cat([scalar, factor * rotation], dim=-1)
