"""Surfaces of the tools, as points and as triangles."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cpdeform.core.scene import Tool
from cpdeform.core.shapes.tool import shape_of

Array = NDArray[np.float64]


def tool_surface(tool: Tool, pose: Array, *, rows: int = 64, columns: int = 128) -> Array:
    """Points of a tool's surface in the world frame.

    Neighbours in the grid are neighbours on the surface, and the last column is the first one again, so that grid cells are
    the quadrilaterals of a closed mesh. A tool that is made from a mesh has a single row of points, evenly on its triangles.

    Args:
        tool: The tool.
        pose: Its pose (8,): position (length units), unit quaternion wxyz, gap (Chopsticks).
        rows: Points from pole to pole, about.
        columns: Points around, about.

    Returns:
        Points (rows, columns, 3), length units; a box has a few more rows and columns than asked for.
    """
    shape = shape_of(tool, gap=float(pose[7]))
    own = shape.triangles()
    local = shape.surface(rows=rows, columns=columns) if own is None else points_on(*own, count=rows * columns)[None]
    # Imported on use: scipy's rotations take a quarter of a second to import.
    from scipy.spatial.transform import Rotation

    w, x, y, z = (float(component) for component in pose[3:7])
    turned = Rotation.from_quat([x, y, z, w]).apply(local.reshape(-1, 3)).reshape(local.shape)
    return np.asarray(turned + np.asarray(pose[:3]), dtype=np.float64)


def covering(surface: Array, *, distance: float) -> Array:
    """Points (K, 3) that cover a surface (R, C, 3) of `tool_surface` evenly, with gaps of about `distance` (length units).

    A single row of points is returned as it is.
    """
    rows, columns = surface.shape[:2]
    if rows == 1:
        return surface.reshape(-1, 3)
    index = np.arange(rows * columns).reshape(rows, columns)
    corners = [index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]]
    triangles = np.concatenate(
        [np.stack([corners[i] for i in chosen], axis=-1).reshape(-1, 3) for chosen in ((0, 1, 2), (0, 2, 3))]
    )
    vertices = surface.reshape(-1, 3)
    sides = vertices[triangles[:, 1:]] - vertices[triangles[:, :1]]
    area = 0.5 * np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    # At the poles of the grid triangles have no area.
    return points_on(vertices, triangles[area > 0.0], count=max(1, int(area.sum() / distance**2)))


def points_on(vertices: Array, triangles: NDArray[np.int64], *, count: int) -> Array:
    """Points (K, 3) in rows on triangles, about `count` of them, one at least on each, as dense on small ones as on large.

    Args:
        vertices: Corners (V, 3), length units.
        triangles: Their indices (F, 3).
        count: About how many points.
    """
    corners = vertices[triangles]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    spacing = float(np.sqrt(area.sum() / count))
    longest = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2).max(axis=1)
    # A long thin triangle has points closer together than needed, but no gaps.
    parts = np.clip(np.ceil(longest / spacing).astype(np.int64), 1, 400)
    found = []
    for number in np.unique(parts):
        first, second = np.divmod(np.arange((number + 1) ** 2), number + 1)
        inside = first + second < number
        # in the middle of the small triangles that stand upright
        shares = (np.stack([first, second], axis=1)[inside] + 1.0 / 3.0) / number
        weights = np.concatenate([1.0 - shares.sum(axis=1, keepdims=True), shares], axis=1)
        found.append(np.einsum("kc,fcx->fkx", weights, corners[parts == number]).reshape(-1, 3))
    return np.concatenate(found)
