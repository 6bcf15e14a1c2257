"""A goal that hangs in the air, lies lower than clay can, or where clay hardly gets down to."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from cpdeform.core.scene import WALL_NODES, Scene, ToolChopsticks
from cpdeform.core.signed_distance import signed_distance
from cpdeform.core.state import tool_pose
from cpdeform.run.checks.finding import Finding
from cpdeform.run.checks.occupancy import solids

FLOATING_CELLS = 2.0
"""Grid cells between a goal's part and what carries it, from which on it counts as floating."""
LEAST_PART = 0.02
"""Part of the goal's particles that is worth telling of."""

INSIDE_CELLS = 0.5
"""Grid cells below where clay comes to rest, from which on a particle counts as one inside the floor's boundary layer."""


def check_goal_floating(scene: Scene, goal: NDArray[np.float64]) -> list[Finding]:
    """Tell of parts of the goal (M, 3), length units, that nothing carries: neither the floor nor a fixed tool.

    Tools that can grip may hold clay up to the end of a stage; then it is but a note.
    """
    if scene.gravity[1] >= 0.0:
        return []
    heights, share = [], 0.0
    labels = solids(goal, FLOATING_CELLS * scene.node_distance)
    free = FLOATING_CELLS * scene.node_distance
    for part in range(int(labels.max()) + 1):
        particles = goal[labels == part]
        height = float(particles[:, 1].min()) - scene.resting_height
        if len(particles) >= LEAST_PART * len(goal) and height > free and not _near_fixed_tool(scene, particles, free):
            heights.append(height)
            share += len(particles) / len(goal)
    if not heights:
        return []
    held = _can_grip(scene)
    span = f"{min(heights):.3g}" if len(heights) == 1 else f"{min(heights):.3g} to {max(heights):.3g}"
    return [
        Finding(
            "note" if held else "warning",
            "goal floating",
            "goal",
            f"{share:.0%} of the goal hangs {span} above where clay rests, {scene.resting_height:.3g}, and "
            + ("only tools can hold it there." if held else "no tools can hold it there."),
            "Lower the goal by that much, or raise the floor (ground_height)"
            + ("; keep it if the tools are to lift the clay." if held else "."),
        )
    ]


def check_goal_below_floor(scene: Scene, clay: NDArray[np.float64], goal: NDArray[np.float64]) -> list[Finding]:
    """Tell of a goal (M, 3) with particles lower than the floor lets clay (N, 3) sink, length units.

    The floor's boundary layer is a few nodes thick. Clay that starts inside it stays as low as it is; other clay rests on top.
    """
    lowest = min(scene.resting_height, float(clay[:, 1].min())) - 0.25 * scene.node_distance
    share = float((goal[:, 1] < lowest).mean())
    if share < LEAST_PART:
        return []
    return [
        Finding(
            "warning",
            "goal below the floor",
            "goal",
            f"{share:.0%} of the goal's particles lie lower than clay can get: it comes to rest at a height of "
            f"{scene.resting_height:.3g}, {WALL_NODES} grid nodes above ground_height, and none starts lower than "
            f"{float(clay[:, 1].min()):.3g}.",
            f"Raise the goal by {max(0.0, lowest + 0.25 * scene.node_distance - float(goal[:, 1].min())):.3g}, "
            "or start the bodies as low.",
        )
    ]


def check_goal_inside_floor(scene: Scene, clay: NDArray[np.float64], goal: NDArray[np.float64]) -> list[Finding]:
    """Tell of parts of a goal (M, 3) inside the floor's boundary layer, in columns of cells where no clay (N, 3) starts as low.

    In this layer clay can rise but never sink. What is squeezed out sideways rises as it thins and stays above the layer, so that
    the lowest part of the goal is not filled. A body that is pushed along as a whole stays in the layer. Positions are in length
    units.
    """
    lowest = scene.resting_height - INSIDE_CELLS * scene.node_distance
    sunk = goal[goal[:, 1] < lowest]
    if len(sunk) < LEAST_PART * len(goal):
        return []
    started = {tuple(column) for column in _columns(scene, clay[clay[:, 1] < lowest])}
    share = sum(tuple(column) not in started for column in _columns(scene, sunk)) / len(goal)
    if share < LEAST_PART:
        return []
    depth = scene.resting_height - float(np.percentile(sunk[:, 1], 1.0))
    return [
        Finding(
            "note",
            "goal inside the floor",
            "goal",
            f"{share:.0%} of the goal lies up to {depth:.3g} inside the floor's boundary layer where no clay starts: clay that is "
            "squeezed there rises, and nothing sinks in this layer again.",
            f"Lower the floor (ground_height), or raise bodies and goal by {depth:.3g}; keep it if bodies are pushed along as a "
            "whole.",
        )
    ]


def _columns(scene: Scene, positions: NDArray[np.float64]) -> list[list[int]]:
    """The column of grid cells that each of some particles (N, 3) is in."""
    columns: list[list[int]] = np.floor(positions[:, [0, 2]] / scene.node_distance).astype(int).tolist()
    return columns


def _near_fixed_tool(scene: Scene, particles: NDArray[np.float64], distance: float) -> bool:
    poses = tool_pose(scene)
    return any(
        float(signed_distance(tool, poses[index], torch.as_tensor(particles)).min()) <= distance
        for index, tool in enumerate(scene.tools)
        if not tool.movable
    )


def _can_grip(scene: Scene) -> bool:
    movable = [tool for tool in scene.tools if tool.movable]
    return len(movable) > 1 or any(isinstance(tool, ToolChopsticks) for tool in movable)
