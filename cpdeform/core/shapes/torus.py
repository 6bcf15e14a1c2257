"""Rings."""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING, Literal

import numpy as np

from cpdeform.core.bounded import Length
from cpdeform.core.shapes.base import Array, Shape
from cpdeform.core.shapes.lengths import along_and_across, length
from cpdeform.core.shapes.meshes import revolve
from cpdeform.core.shapes.tool import ToolBase

if TYPE_CHECKING:
    from torch import Tensor


@dataclasses.dataclass(frozen=True)
class ShapeTorus(Shape):
    """All points within `tube_radius` of the circle of `major_radius` about the y axis, length units."""

    major_radius: float
    tube_radius: float

    def distance(self, x: Tensor, y: Tensor, z: Tensor) -> Tensor:
        """See `Shape`."""
        return length(length(x, z) - self.major_radius, y) - self.tube_radius

    def half_extents(self, axes: Tensor) -> Tensor:
        """See `Shape`."""
        _, across = along_and_across(axes)
        return across * self.major_radius + self.tube_radius

    def surface(self, *, rows: int, columns: int) -> Array:
        """See `Shape`."""
        angle = np.linspace(0.0, 2.0 * np.pi, 4 * rows)
        ring = np.stack([np.cos(angle), np.sin(angle)], axis=1) * self.tube_radius
        return revolve(ring + np.array([self.major_radius, 0.0]), rows=rows, columns=columns)

    @property
    def volume(self) -> float:
        """See `Shape`."""
        major, tube = self.major_radius, self.tube_radius
        # Shells about the y axis, from the ring's inner side outwards; from the axis where a thick tube closes the hole.
        inner = min(major, tube)
        root = math.sqrt(tube**2 - inner**2)
        half_section = 0.5 * (tube**2 * (0.5 * math.pi + math.asin(inner / tube)) + inner * root)
        return 4.0 * math.pi * (root**3 / 3.0 + major * half_section)


class ToolTorus(ToolBase):
    """A ring about the local y axis: `major_radius` to the tube's centre and `tube_radius`, length units."""

    kind: Literal["Torus"] = "Torus"
    major_radius: Length
    tube_radius: Length

    def shape(self, *, gap: Tensor | float | None = None) -> ShapeTorus:
        """See `ToolBase`."""
        return ShapeTorus(self.major_radius, self.tube_radius)

    @property
    def kernel_lengths(self) -> tuple[float, ...]:
        """See `ToolBase`."""
        return (self.major_radius, self.tube_radius)
