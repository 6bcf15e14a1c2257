"""Lengths that signed distances and extents are made of, as torch functions.

They use methods of tensors only, so that torch is not imported before there is a tensor.
"""

from __future__ import annotations

import operator
from functools import reduce
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torch import Tensor


def length(*components: Tensor) -> Tensor:
    """Euclidean length; its gradient at zero is zero, where that of a plain square root is nan."""
    squared = reduce(operator.add, (component * component for component in components))
    if not squared.requires_grad:
        return squared.sqrt()
    positive = squared > 0.0
    root = squared.where(positive, squared.new_ones(())).sqrt()
    return root.where(positive, squared.new_zeros(()))


def segment_distance(x: Tensor, y: Tensor, z: Tensor, half: float) -> Tensor:
    """Distance to the segment y in [-half, half]."""
    return length(x, y - y.clamp(-half, half), z)


def corner_distance(*excess: Tensor) -> Tensor:
    """Distance to the set where every component of `excess`, each a distance to one pair of faces, is negative."""
    outside = length(*(component.clamp(min=0.0) for component in excess))
    return outside + reduce(lambda first, second: first.maximum(second), excess).clamp(max=0.0)


def along_and_across(axes: Tensor) -> tuple[Tensor, Tensor]:
    """Absolute cosine and sine (3,) of the angles between axes, see `Shape.half_extents`, and the local y axis.

    A rod's half width along an axis is its half length times the first, a disc's its radius times the second.
    """
    return axes[:, 1], (1.0 - axes[:, 1] ** 2).clamp(min=0.0).sqrt()
