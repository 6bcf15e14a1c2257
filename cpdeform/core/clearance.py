"""How far a tool has to move to be free of the clay."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from cpdeform.core.rotation import rotate_inverse
from cpdeform.core.scene import Tool
from cpdeform.core.shapes.tool import shape_of
from cpdeform.core.signed_distance import local_distance, signed_distance

CLEARANCE = 5e-4
"""Distance from the clay at which a tool begins a stage, length units."""

LEAST_STEP = 2e-3
"""The least a tool is moved at a time on its way out, length units."""

BISECTIONS = 4
"""Halvings of the last step."""


def depth(tool: Tool, pose: Tensor, particles: Tensor) -> float:
    """How far the deepest particle lies inside of a tool grown by `CLEARANCE`, length units; zero or less where it is free.

    Args:
        tool: The tool.
        pose: Its pose (8,).
        particles: The clay (N, 3), length units.
    """
    return CLEARANCE - float(signed_distance(tool, pose, particles).min())


def way_out(tool: Tool, pose: Tensor, direction: Tensor, particles: Tensor, *, farthest: float) -> float:
    """How far a tool has to move along a direction until it is `CLEARANCE` away from the clay, length units.

    A tool that reaches a depth into the clay is not free before it has moved by that depth, so that steps of that length miss
    no way out, but for gaps smaller than `LEAST_STEP`.

    Args:
        tool: The tool.
        pose: Its pose (8,).
        direction: Unit vector (3,).
        particles: The clay (N, 3), length units.
        farthest: How far it may go, length units.

    Returns:
        The length; 0 where the tool is free, infinity where it is not free within `farthest`.
    """
    # In the tool's frame, the clay that it can meet on its way lies in a tube.
    points, way = rotate_inverse(pose[3:7], particles - pose[:3]), rotate_inverse(pose[3:7], direction)
    half_extents = shape_of(tool, gap=float(pose[7])).half_extents(torch.eye(3).to(points))
    radius = float(torch.linalg.vector_norm(half_extents)) + CLEARANCE
    points = points[torch.linalg.vector_norm(points - (points @ way)[:, None] * way, dim=-1) <= radius]
    if not len(points):
        return 0.0

    def gap(length: float) -> float:
        return float(local_distance(tool, *(points - length * way).unbind(-1), gap=pose[7]).min()) - CLEARANCE

    length, found, step = 0.0, gap(0.0), 0.0
    while found < 0.0:
        step = max(-found, LEAST_STEP)
        length += step
        if length > farthest:
            return math.inf
        found = gap(length)
    if length > 0.0:
        for _ in range(BISECTIONS):
            step *= 0.5
            length = length - step if gap(length - step) >= 0.0 else length
    return length
