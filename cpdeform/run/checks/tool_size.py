"""Lengths of tools: how thin they are, and how far they reach."""

from __future__ import annotations

import math

import numpy as np
import torch

from cpdeform.core.clearance import tool_half_extents
from cpdeform.core.scene import Scene, Tool

LEAST_INFLUENCE = 0.1
"""Share of a tool's velocity below which a node is not touched (PlasticineLab's constant)."""


SURFACE_POINTS = 64
"""Points along each direction of a tool's surface."""


def contact_reach(scene: Scene) -> float:
    """Distance from a tool's surface up to which nodes feel it, length units: ln(10) / softness, or 0 for a hard boundary."""
    return -math.log(LEAST_INFLUENCE) / scene.softness if scene.softness > 0.0 else 0.0


def thickness(tool: Tool) -> float:
    """Width of a tool across its thinnest direction, length units."""
    return 2.0 * float(tool_half_extents(tool, torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=torch.float64)).min())


def bounding_radius(tool: Tool) -> float:
    """Distance of a tool's farthest point from its local origin, length units, to a thousandth."""
    return float(np.linalg.norm(tool.shape().surface(rows=SURFACE_POINTS, columns=SURFACE_POINTS), axis=-1).max())
