"""PlasticineLab's metrics on node masses: soft intersection over union (IoU) and its normalised increment.

References:
    Huang et al., "PlasticineLab: A Soft-Body Manipulation Benchmark with Differentiable Physics", ICLR 2021.
"""

from __future__ import annotations

import torch
from torch import Tensor

from cpdeform.core.errors import InputError


def soft_iou(first: Tensor, second: Tensor) -> Tensor:
    """Soft intersection over union of two grids of node masses, each divided by its own maximum.

    With I = sum(a b), it is I / (sum(a) + sum(b) - I). A grid scores less than 1 against itself unless all of its nonzero
    masses are equal, hence `incremental_iou`.

    Args:
        first: Node masses (..., G, G, G).
        second: Node masses (..., G, G, G), leading axes broadcast with those of `first`.

    Returns:
        Soft IoU (...), dimensionless.

    Raises:
        InputError: The grids differ in size, or a grid has no mass.
    """
    if first.ndim < 3 or second.ndim < 3 or first.shape[-3:] != second.shape[-3:]:
        raise InputError("second", came=f"shape {tuple(second.shape)}", expected=f"the grid of {tuple(first.shape)} (..., G, G, G)")
    first, second = _normalise(first, "first"), _normalise(second, "second")
    axes = (-3, -2, -1)
    intersection = (first * second).sum(dim=axes)
    return intersection / (first.sum(dim=axes) + second.sum(dim=axes) - intersection)


def _normalise(grid: Tensor, name: str) -> Tensor:
    largest = grid.amax(dim=(-3, -2, -1), keepdim=True)
    if not bool((largest > 0.0).all()):
        raise InputError(name, came="a grid without mass", expected="node masses with a positive maximum")
    return grid / largest


def incremental_iou(grid: Tensor, start: Tensor, goal: Tensor) -> Tensor:
    """Normalised incremental IoU: the part of the way from the start's to the goal's own IoU that a result made.

    It is clip((IoU - IoU_start) / (IoU(goal, goal) - IoU_start), 0, 1).

    Args:
        grid: Node masses (..., G, G, G) of the result.
        start: Node masses (..., G, G, G) of the start.
        goal: Node masses (..., G, G, G) of the goal.

    Returns:
        Normalised incremental IoU (...), dimensionless, in [0, 1]; nan where the start equals the goal, since there is no
        way to go.

    Raises:
        InputError: The grids differ in size, or a grid has no mass.
    """
    begin = soft_iou(start, goal)
    return torch.clip((soft_iou(grid, goal) - begin) / (soft_iou(goal, goal) - begin), 0.0, 1.0)
