"""Lengths of tools: how thin they are, and how far they reach."""

from __future__ import annotations

import math

from cpdeform.core.errors import InputError
from cpdeform.core.scene import (
    Manipulator,
    ManipulatorBox,
    ManipulatorChopsticks,
    ManipulatorCylinder,
    ManipulatorRod,
    ManipulatorSphere,
    ManipulatorTorus,
    Scene,
)

LEAST_INFLUENCE = 0.1
"""Share of a tool's velocity below which a node is not touched (PlasticineLab's constant)."""


def contact_reach(scene: Scene) -> float:
    """Distance from a tool's surface up to which nodes feel it, length units: ln(10) / softness, or 0 for a hard boundary."""
    return -math.log(LEAST_INFLUENCE) / scene.softness if scene.softness > 0.0 else 0.0


def thickness(tool: Manipulator) -> float:
    """Width of a tool across its thinnest direction, length units.

    Raises:
        InputError: The tool is of no known kind.
    """
    match tool:
        case ManipulatorSphere() | ManipulatorRod() | ManipulatorChopsticks():
            return 2.0 * tool.radius
        case ManipulatorBox():
            return 2.0 * (min(tool.half_extents) + tool.rounding)
        case ManipulatorCylinder():
            return 2.0 * min(tool.radius, tool.half_height)
        case ManipulatorTorus():
            return 2.0 * tool.tube_radius
    raise InputError("manipulator", came=type(tool).__name__, expected="a manipulator of cpdeform.core.scene")


def bounding_radius(tool: Manipulator) -> float:
    """Distance of a tool's farthest point from its local origin, length units.

    Raises:
        InputError: The tool is of no known kind.
    """
    match tool:
        case ManipulatorSphere():
            return tool.radius
        case ManipulatorRod():
            return 0.5 * tool.height + tool.radius
        case ManipulatorChopsticks():
            return math.hypot(0.5 * tool.gap, tool.height) + tool.radius
        case ManipulatorBox():
            return math.hypot(*tool.half_extents) + tool.rounding
        case ManipulatorCylinder():
            return math.hypot(tool.radius, tool.half_height)
        case ManipulatorTorus():
            return tool.major_radius + tool.tube_radius
    raise InputError("manipulator", came=type(tool).__name__, expected="a manipulator of cpdeform.core.scene")
