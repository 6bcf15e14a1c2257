"""Solid cylinders."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Literal

import numpy as np

from cpdeform.core.bounded import Length
from cpdeform.core.shapes.base import Array, Shape
from cpdeform.core.shapes.lengths import along_and_across, corner_distance, length
from cpdeform.core.shapes.meshes import revolve
from cpdeform.core.shapes.tool import ToolBase

if TYPE_CHECKING:
    from torch import Tensor


@dataclasses.dataclass(frozen=True)
class ShapeCylinder(Shape):
    """All points within `radius` of the y axis and within `half_height` of the origin along it, length units."""

    radius: float
    half_height: float

    def distance(self, x: Tensor, y: Tensor, z: Tensor) -> Tensor:
        """See `Shape`."""
        return corner_distance(length(x, z) - self.radius, y.abs() - self.half_height)

    def half_extents(self, axes: Tensor) -> Tensor:
        """See `Shape`."""
        along, across = along_and_across(axes)
        return along * self.half_height + across * self.radius

    def surface(self, *, rows: int, columns: int) -> Array:
        """See `Shape`."""
        radius, half = self.radius, self.half_height
        profile = np.array([[0.0, -half], [radius, -half], [radius, half], [0.0, half]])
        return revolve(profile, rows=rows, columns=columns)

    @property
    def volume(self) -> float:
        """See `Shape`."""
        return 2.0 * np.pi * self.radius**2 * self.half_height


class ToolCylinder(ToolBase):
    """A solid cylinder about the local y axis: `radius` and `half_height`, length units."""

    kind: Literal["Cylinder"] = "Cylinder"
    radius: Length
    half_height: Length

    def shape(self, *, gap: Tensor | float | None = None) -> ShapeCylinder:
        """See `ToolBase`."""
        return ShapeCylinder(self.radius, self.half_height)

    @property
    def kernel_lengths(self) -> tuple[float, ...]:
        """See `ToolBase`."""
        return (self.radius, self.half_height)
