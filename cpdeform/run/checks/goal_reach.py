"""A goal where the tools do not come."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cpdeform.core.scene import Scene, Tool, ToolRollingPin
from cpdeform.core.task import Task
from cpdeform.run.checks.finding import Finding
from cpdeform.run.checks.tool_size import bounding_radius, contact_reach
from cpdeform.run.checks.tool_speed import ROLLING_RADIUS

KIND = "goal reach"
MOST_OUTSIDE = 0.5
"""Part of what has to be made that may lie where no tool comes: clay is passed on by clay."""
FAR = 99.0
"""Percentile of the distances that counts as the farthest; single particles may stray."""


def check_goal_reach(task: Task, clay: NDArray[np.float64], goal: NDArray[np.float64]) -> list[Finding]:
    """Tell of a goal (M, 3) that the tools cannot bring the clay (N, 3) to, length units."""
    scene = task.scene
    tools = [tool for tool in scene.tools if tool.movable]
    if not tools:
        return [Finding("error", KIND, "scene.tools", "There is no tool that actions move.", "Give one tool an action_scale.")]
    from scipy.spatial import KDTree

    distance = KDTree(clay).query(goal)[0]
    missing = goal[distance > 2.0 * scene.node_distance]
    findings = []
    if len(missing) > 0:
        reached = np.any([_reached(scene, tool, missing) for tool in tools], axis=0)
        outside = float(1.0 - reached.mean())
        if outside > MOST_OUTSIDE:
            findings.append(
                Finding(
                    "warning",
                    KIND,
                    "scene.tools",
                    f"{outside:.0%} of the goal's particles that lie away from the clay are where no tool comes: "
                    "lower_bound and upper_bound keep the tools' positions from it.",
                    "Widen the bounds, or move the goal.",
                )
            )
    far, travel = float(np.percentile(distance, FAR)), max(_travel(tool) for tool in tools) * task.step_count * task.stage_count
    if far > travel:
        findings.append(
            Finding(
                "warning",
                KIND,
                "step_count",
                f"The goal lies up to {far:.3g} from the clay, and in all stages together the tools travel {travel:.3g} at most.",
                f"Raise step_count or stage_count by a factor of {math.ceil(10.0 * far / travel) / 10.0:g}, or move the goal.",
            )
        )
    return findings


def _reached(scene: Scene, tool: Tool, points: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which points (P, 3) a tool may touch, wherever within its bounds it is."""
    reach = bounding_radius(tool) + contact_reach(scene)
    lower, upper = np.asarray(tool.lower_bound) - reach, np.asarray(tool.upper_bound) + reach
    return np.asarray(((points >= lower) & (points <= upper)).all(axis=1))


def _travel(tool: Tool) -> float:
    """The farthest that clay at a tool's surface can be carried in an environment step, length units."""
    scale = tool.action_scale
    if isinstance(tool, ToolRollingPin):
        return math.hypot(scale[0] * ROLLING_RADIUS, scale[2]) + scale[1] * bounding_radius(tool)
    return math.hypot(*scale[:3]) + (math.hypot(*scale[3:6]) * bounding_radius(tool) if len(scale) > 3 else 0.0)
