"""Tools that are thinner than the grid can feel."""

from __future__ import annotations

import torch

from cpdeform.core.scene import Scene, Tool
from cpdeform.core.signed_distance import signed_distance
from cpdeform.core.state import tool_pose
from cpdeform.run.checks.finding import Finding
from cpdeform.run.checks.tool_size import bounding_radius, contact_reach, thickness

KIND = "tool thickness"
LEAST_NODES = 2
"""Node planes that a tool should cover wherever it is. One plane alone shares its particles with planes that let clay through."""


def check_tool_thickness(scene: Scene) -> list[Finding]:
    """Tell of tools that clay passes through, or that nothing feels at all.

    A tool acts at the grid's nodes up to `contact_reach` from its surface, and nowhere else.
    """
    findings = []
    for index, tool in enumerate(scene.tools):
        where, least = f"scene.tools.{index}", LEAST_NODES * scene.node_distance - 2.0 * contact_reach(scene)
        if not tool.movable and felt_nodes(scene, index) == 0:
            findings.append(
                Finding(
                    "error",
                    KIND,
                    where,
                    f"This fixed {tool.kind} can never be felt: it covers none of the grid's nodes, "
                    f"{scene.node_distance:.4g} apart, where alone tools act.",
                    f"Make it at least {least:.4g} thick (it is {thickness(tool):.4g}), move it into the domain, "
                    "or take a finer grid (grid_size).",
                )
            )
        elif thickness(tool) < least:
            findings.append(
                Finding(
                    "warning",
                    KIND,
                    where,
                    f"This {tool.kind} is {thickness(tool):.4g} thick, and clay passes through tools below {least:.4g}: they cover "
                    f"fewer than {LEAST_NODES} of the grid's nodes, {scene.node_distance:.4g} apart.",
                    "Make it thicker, or take a finer grid (grid_size).",
                )
            )
    return findings


def felt_nodes(scene: Scene, index: int) -> int:
    """Number of the grid's nodes that a tool acts at in its start pose."""
    tool, pose = scene.tools[index], tool_pose(scene)[index]
    nodes = _nodes_near(scene, tool, pose[:3])
    return int((signed_distance(tool, pose, nodes) <= contact_reach(scene)).sum())


def _nodes_near(scene: Scene, tool: Tool, centre: torch.Tensor) -> torch.Tensor:
    """Positions (K, 3) of the grid's nodes in a box around a tool, length units."""
    reach = bounding_radius(tool) + contact_reach(scene)
    axes = []
    for value in centre.tolist():
        first = max(0, int((value - reach) * scene.grid_size) - 1)
        last = min(scene.grid_size - 1, int((value + reach) * scene.grid_size) + 1)
        axes.append(torch.arange(first, last + 1, dtype=torch.float64) * scene.node_distance)
    return torch.cartesian_prod(*axes).reshape(-1, 3)
