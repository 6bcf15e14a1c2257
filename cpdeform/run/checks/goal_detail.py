"""Parts of a goal that are finer than the grid, or than the tools that are to make them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cpdeform.core.scene import Scene
from cpdeform.run.checks.finding import Finding
from cpdeform.run.checks.occupancy import filling_radius
from cpdeform.run.checks.tool_size import thickness

KIND = "goal detail"
LEAST_CELLS = 2.0
"""Grid cells that a wall should be thick: thinner clay shares its nodes with nothing but itself and tears."""
LEAST_SHARE = 0.1
"""Part of the goal's volume that is worth telling of. Edges and corners are thin, too, and no fault."""
LEAST_PARTICLES = 100
VOXELS = 5
"""Voxels along the shorter of both lengths that are looked for."""
MOST_VOXELS = 6e6


def check_goal_detail(scene: Scene, goal: NDArray[np.float64]) -> list[Finding]:
    """Tell of walls thinner than two grid cells, and of hollows that no tool fits into.

    Walls are what the goal (M, 3), length units, loses by a morphological opening with a ball of the radius of one cell; hollows
    are what it gains by a closing with a ball as thick as the thinnest tool that moves.
    """
    if len(goal) < LEAST_PARTICLES:
        return []
    wall = 0.5 * LEAST_CELLS * scene.node_distance
    tools = [0.5 * thickness(tool) for tool in scene.tools if tool.movable]
    inside, edge = _voxels(goal, min(wall, *tools, 4.0 * wall), margin=max(wall, *tools, 0.0))
    volume = float(inside.sum())
    thin = float((inside & ~_opened(inside, wall / edge)).sum()) / volume
    findings = []
    if thin > LEAST_SHARE:
        findings.append(
            Finding(
                "note",
                KIND,
                "goal",
                f"{thin:.0%} of the goal is thinner than two grid cells ({2.0 * wall:.3g}), which clay hardly keeps.",
                "Take a finer grid (scene.grid_size) with more particles, more clay, or a goal with thicker walls.",
            )
        )
    hollow = float((~_opened(~inside, min(tools) / edge) & ~inside).sum()) / volume if tools else 0.0
    if hollow > LEAST_SHARE:
        findings.append(
            Finding(
                "note",
                KIND,
                "scene.tools",
                f"Hollows of {hollow:.0%} of the goal's volume are narrower than the thinnest tool ({2.0 * min(tools):.3g}).",
                "Take a thinner tool, or a goal with wider hollows.",
            )
        )
    return findings


def _voxels(goal: NDArray[np.float64], length: float, *, margin: float) -> tuple[NDArray[np.bool_], float]:
    """Which voxels of a grid the goal fills, and their edge, length units."""
    from scipy.spatial import KDTree

    lower, upper = goal.min(axis=0) - 1.5 * margin, goal.max(axis=0) + 1.5 * margin
    edge = max(length / VOXELS, float((np.prod(upper - lower) / MOST_VOXELS) ** (1.0 / 3.0)))
    counts = np.ceil((upper - lower) / edge).astype(int)
    axes = [low + (np.arange(count) + 0.5) * edge for low, count in zip(lower, counts, strict=True)]
    centres = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    # Particles lie half a gap inside of the surface that they fill.
    reach = 0.5 * filling_radius(goal)
    near = KDTree(goal).query(centres, distance_upper_bound=reach)[0] <= reach
    return np.asarray(near.reshape(counts)), edge


def _opened(inside: NDArray[np.bool_], radius: float) -> NDArray[np.bool_]:
    """What balls of a radius, in voxels, reach that fit inside."""
    from scipy.ndimage import distance_transform_edt

    kept = distance_transform_edt(np.pad(inside, 1, constant_values=bool(inside[0, 0, 0]))) > radius
    reached = distance_transform_edt(~kept) <= radius
    return np.asarray(reached[1:-1, 1:-1, 1:-1])
