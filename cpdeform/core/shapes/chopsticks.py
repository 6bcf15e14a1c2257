"""Chopsticks: two parallel rods with a gap that actions open and close."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np

from cpdeform.core.bounded import Length
from cpdeform.core.shapes.base import Array, Shape
from cpdeform.core.shapes.lengths import segment_distance
from cpdeform.core.shapes.rod import ShapeRod
from cpdeform.core.shapes.tool import ToolBase

if TYPE_CHECKING:
    from torch import Tensor


@dataclasses.dataclass(frozen=True)
class ShapeChopsticks(Shape):
    """Two parallel rods of `radius` and `height` at x = +-gap/2, with the origin at the height of their segments' upper ends.

    Attributes:
        radius: Radius of a rod, length units.
        height: Length of a rod's segment, length units.
        gap: Distance between the rods' axes, length units; a tensor (...) for `distance` from many poses at once.
    """

    radius: float
    height: float
    gap: Tensor | float

    def distance(self, x: Tensor, y: Tensor, z: Tensor) -> Tensor:
        """See `Shape`."""
        half = 0.5 * self.height
        aside = x.abs() - 0.5 * self.gap
        return segment_distance(aside, y + half, z, half) - self.radius

    def half_extents(self, axes: Tensor) -> Tensor:
        """See `Shape`."""
        import torch

        return axes @ torch.tensor([0.5 * float(self.gap), self.height, 0.0]).to(axes) + self.radius

    def surface(self, *, rows: int, columns: int) -> Array:
        """See `Shape`."""
        rod = ShapeRod(self.radius, self.height).surface(rows=rows // 2, columns=columns) - [0.0, 0.5 * self.height, 0.0]
        aside = np.array([0.5 * float(self.gap), 0.0, 0.0])
        # Both rods in one grid: the cells between one rod's last pole and the other's first have no area.
        return np.concatenate([rod - aside, rod + aside])

    @property
    def volume(self) -> float:
        """See `Shape`."""
        radius, gap = self.radius, float(self.gap)
        both = 2.0 * ShapeRod(radius, self.height).volume
        if gap >= 2.0 * radius:
            return both
        # What both hold counts once: a lens of two discs along the segments, and half a lens of two balls at either end.
        disc_lens = 2.0 * radius**2 * math.acos(0.5 * gap / radius) - 0.5 * gap * math.sqrt(4.0 * radius**2 - gap**2)
        ball_lens = math.pi / 12.0 * (4.0 * radius + gap) * (2.0 * radius - gap) ** 2
        return both - disc_lens * self.height - ball_lens


class ToolChopsticks(ToolBase):
    """Two parallel rods of `radius` and `height` at x = +-gap/2 of the local frame, whose origin is at their upper ends.

    Attributes:
        radius: Radius of a rod, length units.
        height: Length of a rod's segment, length units.
        gap: Start distance between the rods' axes, length units; actions never close it below 0.06.
    """

    kind: Literal["Chopsticks"] = "Chopsticks"
    radius: Length
    height: Length
    gap: Length = 0.06
    action_meanings: ClassVar[Mapping[int, str]] = MappingProxyType(
        {0: "fixed", 7: "translation, rotation in the tool's own frame, closing of the gap"}
    )

    def shape(self, *, gap: Tensor | float | None = None) -> ShapeChopsticks:
        """See `ToolBase`."""
        return ShapeChopsticks(self.radius, self.height, self.gap if gap is None else gap)

    @property
    def kernel_lengths(self) -> tuple[float, ...]:
        """See `ToolBase`; the gap is a number of the pose."""
        return (self.radius, self.height)

    @property
    def start_gap(self) -> float:
        """See `ToolBase`."""
        return self.gap
