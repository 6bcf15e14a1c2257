"""PlasticineLab's contact term: how far each movable tool is from the body."""

from __future__ import annotations

from typing import Literal, get_args

import torch
from torch import Tensor

from cpdeform.core.errors import InputError
from cpdeform.core.scene import Scene, Tool
from cpdeform.core.signed_distance import signed_distance

ContactKind = Literal["hard", "soft", "plasticinelab"]

SOFT_WEIGHT_DECAY = 1e4
"""Decay of a particle's weight 1/(1 + decay d^2) in the soft contact term, 1/length^2."""


def check_contact_kind(kind: str) -> None:
    """Raise `InputError` unless `kind` is a `ContactKind`."""
    if kind not in get_args(ContactKind):
        raise InputError("contact", came=f'"{kind}"', expected="one of " + ", ".join(get_args(ContactKind)))


def contact_loss(scene: Scene, positions: Tensor, tool_poses: Tensor, *, kind: ContactKind = "hard") -> Tensor:
    """Squared distance between the body and each movable tool, summed over the tools.

    With d_i = max(signed distance of particle i, 0), a tool contributes (min_i d_i)^2 (``"hard"``) or
    (sum_i w_i d_i / sum_i w_i)^2 with w_i = 1/(1 + 10^4 d_i^2) (``"soft"``). ``"plasticinelab"`` has the value of ``"hard"``
    and the gradient that PlasticineLab computes for it: 2 (min_i d_i) times the sum, not the nearest particle's share, of the
    gradients of all d_i (its automatic differentiation passes through an atomic minimum as through a sum). With 10,000
    particles that pulls tools to the body thousands of times harder than the loss's own gradient.

    Args:
        scene: Whose tools `tool_poses` are.
        positions: Particle positions (..., N, 3), length units.
        tool_poses: Tool poses (..., M, 8) at the same times; see `State.tool_pose`.
        kind: ``"hard"``, ``"soft"`` or ``"plasticinelab"``.

    Returns:
        Contact loss (...), length units squared; zero in a scene without movable tools.

    Raises:
        InputError: `kind` is unknown.

    References:
        Huang et al., "PlasticineLab: A Soft-Body Manipulation Benchmark with Differentiable Physics", ICLR 2021.
    """
    check_contact_kind(kind)
    distance = {"hard": _hard_distance, "soft": _soft_distance, "plasticinelab": _spread_distance}[kind]
    total = positions.new_zeros(positions.shape[:-2])
    for index, tool in enumerate(scene.tools):
        if tool.movable:
            total = total + torch.square(distance(tool, tool_poses[..., index, :], positions))
    return total


def _hard_distance(tool: Tool, pose: Tensor, positions: Tensor) -> Tensor:
    """Distance (...) to the nearest particle; only that one has to be part of the autograd graph."""
    with torch.no_grad():
        index = signed_distance(tool, pose, positions).argmin(dim=-1)
    nearest = positions.gather(-2, index[..., None, None].expand(*index.shape, 1, 3))
    return signed_distance(tool, pose, nearest).squeeze(-1).clamp(min=0.0)


def _soft_distance(tool: Tool, pose: Tensor, positions: Tensor) -> Tensor:
    """Mean (...) of the particles' distances, weighted towards the near ones."""
    gap = signed_distance(tool, pose, positions).clamp(min=0.0)
    weight = 1.0 / (1.0 + SOFT_WEIGHT_DECAY * gap * gap)
    return (weight * gap).sum(dim=-1) / weight.sum(dim=-1)


def _spread_distance(tool: Tool, pose: Tensor, positions: Tensor) -> Tensor:
    """Distance (...) to the nearest particle, with the sum of all particles' gradients."""
    gap = signed_distance(tool, pose, positions).clamp(min=0.0)
    total = gap.sum(dim=-1)
    return gap.amin(dim=-1).detach() + (total - total.detach())
