"""Balls: a tool and a body."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Literal

import numpy as np

from cpdeform.core.bounded import Length
from cpdeform.core.model import Vector3
from cpdeform.core.shapes.base import Array, RandomNumbers, Shape
from cpdeform.core.shapes.body import BodyBase
from cpdeform.core.shapes.lengths import length
from cpdeform.core.shapes.meshes import arc, mirrored, revolve
from cpdeform.core.shapes.tool import ToolBase

if TYPE_CHECKING:
    from torch import Tensor


@dataclasses.dataclass(frozen=True)
class ShapeSphere(Shape):
    """All points within `radius` of the origin, length units."""

    radius: float

    def distance(self, x: Tensor, y: Tensor, z: Tensor) -> Tensor:
        """See `Shape`."""
        return length(x, y, z) - self.radius

    def half_extents(self, axes: Tensor) -> Tensor:
        """See `Shape`."""
        return axes.new_full((3,), self.radius)

    def surface(self, *, rows: int, columns: int) -> Array:
        """See `Shape`."""
        return revolve(mirrored(arc(self.radius, rows)), rows=rows, columns=columns)

    @property
    def volume(self) -> float:
        """See `Shape`."""
        return 4.0 / 3.0 * np.pi * self.radius**3

    def sample(self, count: int, generator: RandomNumbers) -> Array:
        """See `Shape`."""
        direction = generator.standard_normal((count, 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        share = generator.uniform(0.0, 1.0, (count, 1)) ** (1.0 / 3.0)
        # in PlasticineLab's order, so that its sample is met to the last bit
        return np.asarray(direction * share * self.radius)


class ToolSphere(ToolBase):
    """A ball. Attributes: radius, length units."""

    kind: Literal["Sphere"] = "Sphere"
    radius: Length

    def shape(self, *, gap: Tensor | float | None = None) -> ShapeSphere:
        """See `ToolBase`."""
        return ShapeSphere(self.radius)

    @property
    def kernel_lengths(self) -> tuple[float, ...]:
        """See `ToolBase`."""
        return (self.radius,)


class BodySphere(BodyBase):
    """A ball of clay. Attributes: radius, length units; see `BodyBase` for the others."""

    kind: Literal["sphere"] = "sphere"
    radius: Length

    def shape(self) -> ShapeSphere:
        """See `BodyBase`."""
        return ShapeSphere(self.radius)

    @property
    def half_extents(self) -> Vector3:
        """See `BodyBase`."""
        return (self.radius, self.radius, self.radius)
