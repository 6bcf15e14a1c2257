"""Tools that are faster than the time step can follow."""

from __future__ import annotations

import math

from cpdeform.core.scene import Scene, Tool, ToolChopsticks, ToolRollingPin
from cpdeform.run.checks.finding import Finding
from cpdeform.run.checks.tool_size import bounding_radius

KIND = "tool speed"
ROLLING_RADIUS = 0.03
"""Length units that a rolling pin rolls a radian (PlasticineLab's constant)."""
MOST_CELLS = 0.5
"""Cells that a tool may move in a substep. Clay that is pushed moves as far, and beyond about two thirds the explicit time step
breaks down (measured: a ball of radius 0.03 pushes a block at half a cell a substep, at 0.7 positions become nan, and faster balls
cross the block between two substeps)."""


def check_tool_speed(scene: Scene) -> list[Finding]:
    """Tell of tools whose actions move them through clay between two substeps."""
    findings = []
    for index, tool in enumerate(scene.tools):
        cells = largest_motion(tool) / scene.substeps / scene.node_distance
        if cells > MOST_CELLS:
            findings.append(
                Finding(
                    "warning",
                    KIND,
                    f"scene.tools.{index}.action_scale",
                    f"At action 1 this {tool.kind} moves {cells:.3g} grid cells a substep; above {MOST_CELLS:g} it passes through "
                    "clay instead of pushing it, or the simulation breaks down.",
                    f"Scale its motion by {0.9 * MOST_CELLS / cells:.2g}, or raise substeps.",
                )
            )
    return findings


def largest_motion(tool: Tool) -> float:
    """The farthest that any point of a tool moves in an environment step along one action at a time, length units.

    Plans rarely have all of a tool's actions at their limits at once.
    """
    scale = tool.action_scale
    if not scale:
        return 0.0
    radius = bounding_radius(tool)
    if isinstance(tool, ToolRollingPin):
        return max(scale[0] * ROLLING_RADIUS, scale[1] * radius, scale[2])
    grasp = 0.5 * scale[6] if isinstance(tool, ToolChopsticks) else 0.0
    turn = math.hypot(*scale[3:6]) * radius if len(scale) > 3 else 0.0
    return max(*scale[:3], turn, grasp)
