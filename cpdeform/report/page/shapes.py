"""Tools and goal for the page: triangle meshes, and how far from the goal each place is."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cpdeform.core.scene import Tool
from cpdeform.core.shapes.base import Shape
from cpdeform.core.shapes.mesh import ShapeMesh
from cpdeform.core.shapes.tool import shape_of
from cpdeform.report.page.encoding import encode_array, quantise
from cpdeform.report.surface import clay_surface, particle_spacing

Array = NDArray[np.float64]

TOOL_ROWS = 16
TOOL_COLUMNS = 36
WIDE_GAP = 1.0
"""Gap of a tool's second surface, length units."""

MOST_TRIANGLES = 30_000
"""Triangles of a tool's own mesh that a page holds."""

DISTANCE_NODES = 48
"""Nodes along each edge of the domain at which the distance from the goal is kept."""

NEAREST_END, FARTHEST_END = 0.02, 0.25
"""Least and largest end of the scale of distances, length units."""


def describe_tools(tools: Sequence[Tool], arrays: dict[str, Callable[[], bytes]]) -> list[dict[str, Any]]:
    """Describe the tools' surfaces in their own frames, and add the points.

    A tool with a gap has two surfaces, at gaps of 0 and of `WIDE_GAP`. Each point moves with the gap evenly, so that those between
    are mixtures of the two. A tool that is made from a mesh has its triangles.
    """
    described: list[dict[str, Any]] = []
    for number, tool in enumerate(tools):
        gaps = (0.0, WIDE_GAP) if tool.start_gap > 0.0 else (0.0,)
        own = shape_of(tool).triangles()
        if own is not None:
            vertices, triangles = _fewer(*own, shape_of(tool))
            arrays[f"tool-{number}"] = _floats(vertices)
            arrays[f"tool-{number}-triangles"] = _indices(triangles)
            names = {"array": f"tool-{number}", "triangles": f"tool-{number}-triangles"}
            described.append({"kind": tool.kind, **names, "surfaces": 1, "points": len(vertices)})
            continue
        surfaces = [shape_of(tool, gap=gap).surface(rows=TOOL_ROWS, columns=TOOL_COLUMNS) for gap in gaps]
        name = f"tool-{number}"
        arrays[name] = _floats(np.stack(surfaces))
        rows, columns = surfaces[0].shape[:2]
        size = {"points": rows * columns, "rows": rows, "columns": columns}
        described.append({"kind": tool.kind, "array": name, "surfaces": len(gaps), **size})
    return described


def describe_goal(goal: Array, start: Array, arrays: dict[str, Callable[[], bytes]]) -> dict[str, Any]:
    """Describe the goal's surface and the distances from it, and add both.

    Args:
        goal: Goal particles (M, 3), length units.
        start: Particles (N, 3) where the run began; the farthest of them is at the end of the scale.
        arrays: The page's arrays.
    """
    from scipy.spatial import cKDTree

    mesh = clay_surface(goal)
    farthest = float(np.clip(cKDTree(goal).query(start)[0].max(), NEAREST_END, FARTHEST_END))
    arrays["goal-vertices"] = lambda: encode_array(quantise(mesh.vertices))
    arrays["goal-triangles"] = lambda: encode_array(mesh.triangles.astype(np.uint32))
    levels = np.round(255.0 * goal_distance(goal, farthest=farthest) / farthest).astype(np.uint8)
    arrays["goal-distance"] = lambda: encode_array(levels)
    return {
        "vertices": "goal-vertices",
        "triangles": "goal-triangles",
        "distance": {"array": "goal-distance", "nodes": DISTANCE_NODES, "farthest": farthest},
    }


def goal_distance(goal: Array, *, farthest: float, nodes: int = DISTANCE_NODES) -> Array:
    """How far nodes of a grid over the domain lie outside of the goal, (nodes, nodes, nodes) by x, y, z, length units.

    The goal is taken as balls about its particles, as wide as their spacing; distances end at `farthest`, length units.
    """
    from scipy.spatial import cKDTree

    line = np.linspace(0.0, 1.0, nodes)
    places = np.stack(np.meshgrid(line, line, line, indexing="ij"), axis=-1).reshape(-1, 3)
    distance, _ = cKDTree(goal).query(places, distance_upper_bound=farthest + 0.1)
    return np.asarray(np.clip(distance - particle_spacing(goal), 0.0, farthest).reshape(nodes, nodes, nodes))


def _fewer(vertices: Array, triangles: NDArray[np.int64], shape: Shape) -> tuple[Array, NDArray[np.int64]]:
    """A mesh that a page has room for: its own, or where that is too fine, the zero of its signed distance on a grid."""
    if len(triangles) <= MOST_TRIANGLES or not isinstance(shape, ShapeMesh):
        return vertices, triangles
    from skimage.measure import marching_cubes

    grid = shape.grid
    # Its sides are turned outwards, to where the distance grows.
    found, faces = marching_cubes(grid.distance, 0.0, step_size=2, gradient_direction="descent")[:2]
    return (found - 0.5 * (np.array(grid.distance.shape) - 1)) * grid.spacing, faces.astype(np.int64)


def _indices(values: NDArray[np.int64]) -> Callable[[], bytes]:
    return lambda: encode_array(values.astype(np.uint32))


def _floats(values: Array) -> Callable[[], bytes]:
    return lambda: encode_array(values.astype(np.float32))
