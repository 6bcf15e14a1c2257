"""Surfaces of the tools, as grids of points."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cpdeform.core.scene import Tool
from cpdeform.core.shapes.tool import shape_of

Array = NDArray[np.float64]


def tool_surface(tool: Tool, pose: Array, *, rows: int = 64, columns: int = 128) -> Array:
    """Points of a tool's surface in the world frame.

    Neighbours in the grid are neighbours on the surface, and the last column is the first one again, so that grid cells are
    the quadrilaterals of a closed mesh.

    Args:
        tool: The tool.
        pose: Its pose (8,): position (length units), unit quaternion wxyz, gap (Chopsticks).
        rows: Points from pole to pole, about.
        columns: Points around, about.

    Returns:
        Points (rows, columns, 3), length units; a box has a few more rows and columns than asked for.
    """
    local = shape_of(tool, gap=float(pose[7])).surface(rows=rows, columns=columns)
    # Imported on use: scipy's rotations take a quarter of a second to import.
    from scipy.spatial.transform import Rotation

    w, x, y, z = (float(component) for component in pose[3:7])
    turned = Rotation.from_quat([x, y, z, w]).apply(local.reshape(-1, 3)).reshape(local.shape)
    return np.asarray(turned + np.asarray(pose[:3]), dtype=np.float64)
