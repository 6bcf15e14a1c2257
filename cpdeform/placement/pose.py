"""Candidate poses: how a tool, or a pair of tools, takes hold of a body.

References:
    Li et al., "Contact Points Discovery for Soft-Body Manipulations with Differentiable Physics", ICLR 2022, section "Multiple
    Manipulator Placement With Heuristic".
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType

import torch
from torch import Tensor

from cpdeform.core.errors import InputError
from cpdeform.core.rotation import multiply, rotate
from cpdeform.core.scene import Manipulator, Vector3

GRASP_DIRECTIONS: Mapping[str, Vector3] = MappingProxyType(
    {"left-right": (1.0, 0.0, 0.0), "top-bottom": (0.0, 1.0, 0.0), "front-back": (0.0, 0.0, 1.0)}
)
"""Axis along which the tools of a grasp face each other."""

DIRECT, APART, CURRENT, PUSH = "direct", "apart", "current", "push"
"""Candidates without an axis: the score alone places one tool; each tool at a contact point of its own; tools stay; each tool
behind clay of its own, see `cpdeform.placement.push`."""

POSE_NAMES = (*GRASP_DIRECTIONS, DIRECT, APART, CURRENT, PUSH)


def check_poses(poses: Sequence[str] | None) -> tuple[str, ...] | None:
    """The names as a tuple; None stays None.

    Raises:
        InputError: A name is unknown or given twice, or there is none.
    """
    if poses is None:
        return None
    names = (poses,) if isinstance(poses, str) else tuple(poses)
    for name in names:
        if name not in POSE_NAMES or names.count(name) > 1:
            expected = f"distinct names out of {', '.join(POSE_NAMES)}"
            raise InputError("poses", came=", ".join(map(str, names)), expected=expected)
    if not names:
        raise InputError("poses", came="no pose", expected=f"at least one of {', '.join(POSE_NAMES)}")
    return names


def turned(manipulator: Manipulator, direction: Tensor) -> Tensor:
    """Rotation in which a tool presses along a direction: a flat one its broadest face; round ones keep their start rotation.

    A plate pressed edge-on into the clay would cut it. A round tool's start rotation says how the scene means it to be held.

    Args:
        manipulator: The tool.
        direction: Unit vector (3,), world frame.

    Returns:
        Unit quaternion (4,), wxyz.
    """
    start = torch.as_tensor(manipulator.rotation_wxyz).to(direction)
    start = _unit(start)
    if manipulator.thinnest_axis is None:
        return start
    thinnest = torch.zeros_like(direction)
    thinnest[manipulator.thinnest_axis] = 1.0
    return multiply(_shortest_turn(rotate(start, thinnest), direction), start)


def _shortest_turn(start: Tensor, end: Tensor) -> Tensor:
    """The smallest rotation (4,) that takes one unit vector (3,) to another, or to its opposite where that is nearer."""
    end = end if float(start @ end) >= 0.0 else -end
    quaternion = torch.cat([(1.0 + start @ end).reshape(1), torch.linalg.cross(start, end)])
    return _unit(quaternion)


def _unit(vector: Tensor) -> Tensor:
    length: Tensor = torch.linalg.vector_norm(vector)
    return vector / length
