"""Surfaces of the tools, as grids of points."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cpdeform.core.errors import InputError
from cpdeform.core.scene import (
    Manipulator,
    ManipulatorBox,
    ManipulatorChopsticks,
    ManipulatorCylinder,
    ManipulatorRod,
    ManipulatorSphere,
    ManipulatorTorus,
)

Array = NDArray[np.float64]

ARC_POINTS = 12
"""Points on each rounded quarter turn of a block."""


def tool_surface(manipulator: Manipulator, pose: Array, *, rows: int = 64, columns: int = 128) -> Array:
    """Points of a tool's surface in the world frame.

    Neighbours in the grid are neighbours on the surface, and the last column is the first one again, so that grid cells are
    the quadrilaterals of a closed mesh.

    Args:
        manipulator: The tool.
        pose: Its pose (8,): position (length units), unit quaternion wxyz, gap (Chopsticks).
        rows: Points from pole to pole, about.
        columns: Points around, about.

    Returns:
        Points (rows, columns, 3), length units; a box has a few more rows and columns than asked for.
    """
    if isinstance(manipulator, ManipulatorBox):
        local = _box(manipulator, rows, columns)
    elif isinstance(manipulator, ManipulatorChopsticks):
        rod = _revolve(_profile(manipulator, rows // 2), columns) - [0.0, 0.5 * manipulator.height, 0.0]
        aside = np.array([0.5 * float(pose[7]), 0.0, 0.0])
        # Both rods in one grid: the cells between one rod's last pole and the other's first have no area.
        local = np.concatenate([rod - aside, rod + aside])
    else:
        local = _revolve(_profile(manipulator, rows), columns)
    # Imported on use: scipy's rotations take a quarter of a second to import.
    from scipy.spatial.transform import Rotation

    w, x, y, z = (float(component) for component in pose[3:7])
    turned = Rotation.from_quat([x, y, z, w]).apply(local.reshape(-1, 3)).reshape(local.shape)
    return np.asarray(turned + np.asarray(pose[:3]), dtype=np.float64)


def _profile(manipulator: Manipulator, rows: int) -> Array:
    """Curve (rows, 2) of distance from the y axis and height whose revolution is the surface, length units."""
    quarter = np.linspace(-0.5 * np.pi, 0.0, rows)
    match manipulator:
        case ManipulatorSphere():
            half = np.stack([np.cos(quarter), np.sin(quarter)], axis=1) * manipulator.radius
            corners = np.concatenate([half, (half * [1.0, -1.0])[::-1]])
        case ManipulatorRod() | ManipulatorChopsticks():
            half = np.stack([np.cos(quarter), np.sin(quarter)], axis=1) * manipulator.radius - [0.0, 0.5 * manipulator.height]
            corners = np.concatenate([half, (half * [1.0, -1.0])[::-1]])
        case ManipulatorCylinder():
            radius, half_height = manipulator.radius, manipulator.half_height
            corners = np.array([[0.0, -half_height], [radius, -half_height], [radius, half_height], [0.0, half_height]])
        case ManipulatorTorus():
            angle = np.linspace(0.0, 2.0 * np.pi, 4 * rows)
            ring = np.stack([np.cos(angle), np.sin(angle)], axis=1) * manipulator.tube_radius
            corners = ring + np.array([manipulator.major_radius, 0.0])
        case _:
            raise InputError("manipulator", came=type(manipulator).__name__, expected="a manipulator of cpdeform.core.scene")
    # Even spacing along the curve keeps the cells of the mesh of about one size.
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))])
    even = np.linspace(0.0, length[-1], rows)
    return np.stack([np.interp(even, length, corners[:, axis]) for axis in range(2)], axis=1)


def _revolve(profile: Array, columns: int) -> Array:
    """Turn a profile (R, 2) about the local y axis into points (R, columns, 3)."""
    angle = np.linspace(0.0, 2.0 * np.pi, columns)
    radius, height = profile[:, :1], profile[:, 1:]
    return np.stack([radius * np.cos(angle), height + 0.0 * angle, radius * np.sin(angle)], axis=-1)


def _box(box: ManipulatorBox, rows: int, columns: int) -> Array:
    """Points (R, C, 3) of a rounded block: a sphere cut into octants, which are moved apart to the corners.

    The cells that the octants' seams are stretched to are the faces; a face is flat, and is filled with further points.
    """
    latitude = _seams(np.linspace(-0.5 * np.pi, 0.0, ARC_POINTS), np.linspace(0.0, 0.5 * np.pi, ARC_POINTS))
    quadrants = [np.linspace(0.5 * np.pi * i, 0.5 * np.pi * (i + 1), ARC_POINTS) for i in range(4)]
    longitude = _seams(*quadrants)
    row_sign = np.repeat([-1.0, 1.0], ARC_POINTS)[:, None]
    x_sign, z_sign = np.repeat([1.0, -1.0, -1.0, 1.0], ARC_POINTS), np.repeat([1.0, 1.0, -1.0, -1.0], ARC_POINTS)
    cos_latitude, sin_latitude = np.cos(latitude)[:, None], np.sin(latitude)[:, None]
    normal = np.stack([cos_latitude * np.cos(longitude), sin_latitude + 0.0 * longitude, cos_latitude * np.sin(longitude)], axis=-1)
    corner = np.stack([x_sign + 0.0 * row_sign, row_sign + 0.0 * x_sign, z_sign + 0.0 * row_sign], axis=-1)
    points = corner * np.asarray(box.half_extents) + box.rounding * normal
    points = np.concatenate([points, points[:, :1]], axis=1)
    # The pole's row is the outline of the top or bottom face: closed by a row at the face's centre.
    height = box.half_extents[1] + box.rounding
    caps = [np.broadcast_to([0.0, sign * height, 0.0], (1, points.shape[1], 3)) for sign in (-1.0, 1.0)]
    return _densify(_densify(np.concatenate([caps[0], points, caps[1]]), rows, axis=0), columns, axis=1)


def _seams(*parts: Array) -> Array:
    """Join angles; the common end of two parts is kept twice."""
    return np.concatenate(parts)


def _densify(points: Array, count: int, *, axis: int) -> Array:
    """Put further points between the points along an axis, in proportion to the length of the gaps; the old ones are kept."""
    gaps = np.linalg.norm(np.diff(points, axis=axis), axis=-1).max(axis=1 - axis)
    extra = np.maximum(np.ceil(gaps / max(float(gaps.sum()), 1e-12) * count).astype(int), 1)
    old = np.arange(points.shape[axis], dtype=np.float64)
    new = np.concatenate([*(np.arange(n) / n + i for i, n in enumerate(extra)), old[-1:]])
    lower = np.minimum(new.astype(int), len(old) - 2)
    weight = (new - lower)[:, None, None] if axis == 0 else (new - lower)[None, :, None]
    return np.asarray((1.0 - weight) * np.take(points, lower, axis=axis) + weight * np.take(points, lower + 1, axis=axis))
