"""How tools are turned to take hold of a body, and the axes along which pairs of them face each other.

References:
    Li et al., "Contact Points Discovery for Soft-Body Manipulations with Differentiable Physics", ICLR 2022, section "Multiple
    Tool Placement With Heuristic".
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

import torch
from torch import Tensor

from cpdeform.core.rotation import multiply, rotate
from cpdeform.core.scene import Tool, Vector3

GRASP_DIRECTIONS: Mapping[str, Vector3] = MappingProxyType(
    {"left-right": (1.0, 0.0, 0.0), "top-bottom": (0.0, 1.0, 0.0), "front-back": (0.0, 0.0, 1.0)}
)
"""Axis along which the tools of a grasp face each other."""


def turned(tool: Tool, direction: Tensor) -> Tensor:
    """Rotation in which a tool presses along a direction: a flat one its broadest face; round ones keep their start rotation.

    A plate pressed edge-on into the clay would cut it. A round tool's start rotation says how the scene means it to be held.

    Args:
        tool: The tool.
        direction: Unit vector (3,), world frame.

    Returns:
        Unit quaternion (4,), wxyz.
    """
    start = torch.as_tensor(tool.rotation_wxyz).to(direction)
    start = _unit(start)
    if tool.thinnest_axis is None:
        return start
    thinnest = torch.zeros_like(direction)
    thinnest[tool.thinnest_axis] = 1.0
    return multiply(_shortest_turn(rotate(start, thinnest), direction), start)


def _shortest_turn(start: Tensor, end: Tensor) -> Tensor:
    """The smallest rotation (4,) that takes one unit vector (3,) to another, or to its opposite where that is nearer."""
    end = end if float(start @ end) >= 0.0 else -end
    quaternion = torch.cat([(1.0 + start @ end).reshape(1), torch.linalg.cross(start, end)])
    return _unit(quaternion)


def _unit(vector: Tensor) -> Tensor:
    length: Tensor = torch.linalg.vector_norm(vector)
    return vector / length
