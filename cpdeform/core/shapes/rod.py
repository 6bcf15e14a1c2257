"""Rods with round ends: the capsule and the rolling pin."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np

from cpdeform.core.bounded import Length
from cpdeform.core.shapes.base import Array, Shape
from cpdeform.core.shapes.lengths import along_and_across, segment_distance
from cpdeform.core.shapes.meshes import arc, mirrored, revolve
from cpdeform.core.shapes.tool import ToolBase

if TYPE_CHECKING:
    from torch import Tensor


@dataclasses.dataclass(frozen=True)
class ShapeRod(Shape):
    """All points within `radius` of the segment y in [-height/2, height/2], length units."""

    radius: float
    height: float

    def distance(self, x: Tensor, y: Tensor, z: Tensor) -> Tensor:
        """See `Shape`."""
        return segment_distance(x, y, z, 0.5 * self.height) - self.radius

    def half_extents(self, axes: Tensor) -> Tensor:
        """See `Shape`."""
        along, _ = along_and_across(axes)
        return along * (0.5 * self.height) + self.radius

    def surface(self, *, rows: int, columns: int) -> Array:
        """See `Shape`."""
        return revolve(mirrored(arc(self.radius, rows) - [0.0, 0.5 * self.height]), rows=rows, columns=columns)

    @property
    def volume(self) -> float:
        """See `Shape`."""
        return np.pi * self.radius**2 * (self.height + 4.0 / 3.0 * self.radius)


class ToolRod(ToolBase):
    """All points within `radius` of the segment y in [-height/2, height/2] of the local frame, length units."""

    radius: Length
    height: Length

    def shape(self, *, gap: Tensor | float | None = None) -> ShapeRod:
        """See `ToolBase`."""
        return ShapeRod(self.radius, self.height)

    @property
    def kernel_lengths(self) -> tuple[float, ...]:
        """See `ToolBase`."""
        return (self.radius, self.height)


class ToolCapsule(ToolRod):
    """A rod that is moved like any tool."""

    kind: Literal["Capsule"] = "Capsule"


class ToolRollingPin(ToolRod):
    """A rod that rolls.

    Its three actions turn it about its own axis (radians), rolling it sideways by 0.03 length units a radian, turn it about the
    vertical (radians), and lift it (length units).
    """

    kind: Literal["RollingPin"] = "RollingPin"
    action_meanings: ClassVar[Mapping[int, str]] = MappingProxyType({0: "fixed", 3: "roll, turn, lift"})
