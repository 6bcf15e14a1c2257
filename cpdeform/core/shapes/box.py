"""Blocks: a tool, with edges that may be rounded, and a body."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Literal

import numpy as np
from pydantic import Field

from cpdeform.core.bounded import Coordinate, Lengths3
from cpdeform.core.model import Vector3
from cpdeform.core.shapes.base import Array, RandomNumbers, Shape
from cpdeform.core.shapes.body import BodyBase
from cpdeform.core.shapes.lengths import corner_distance
from cpdeform.core.shapes.tool import ToolBase

if TYPE_CHECKING:
    from torch import Tensor

ARC_POINTS = 12
"""Points on each rounded quarter turn of a block's mesh."""


@dataclasses.dataclass(frozen=True)
class ShapeBox(Shape):
    """A block of half edges `core` (3,), grown by `rounding` on all sides, length units."""

    core: Vector3
    rounding: float = 0.0

    def distance(self, x: Tensor, y: Tensor, z: Tensor) -> Tensor:
        """See `Shape`."""
        excess = [axis.abs() - half for axis, half in zip((x, y, z), self.core, strict=True)]
        return corner_distance(*excess) - self.rounding

    def half_extents(self, axes: Tensor) -> Tensor:
        """See `Shape`."""
        import torch

        return axes @ torch.tensor(self.core).to(axes) + self.rounding

    def surface(self, *, rows: int, columns: int) -> Array:
        """See `Shape`.

        A sphere is cut into octants, which are moved apart to the corners. The cells that the octants' seams are stretched to are
        the faces; a face is flat, and is filled with further points.
        """
        # An angle at which two octants meet is there twice, once for each.
        latitude = np.concatenate([np.linspace(-0.5 * np.pi, 0.0, ARC_POINTS), np.linspace(0.0, 0.5 * np.pi, ARC_POINTS)])
        longitude = np.concatenate([np.linspace(0.5 * np.pi * i, 0.5 * np.pi * (i + 1), ARC_POINTS) for i in range(4)])
        row_sign = np.repeat([-1.0, 1.0], ARC_POINTS)[:, None]
        x_sign, z_sign = np.repeat([1.0, -1.0, -1.0, 1.0], ARC_POINTS), np.repeat([1.0, 1.0, -1.0, -1.0], ARC_POINTS)
        cosine, sine = np.cos(latitude)[:, None], np.sin(latitude)[:, None]
        normal = np.stack([cosine * np.cos(longitude), sine + 0.0 * longitude, cosine * np.sin(longitude)], axis=-1)
        corner = np.stack([x_sign + 0.0 * row_sign, row_sign + 0.0 * x_sign, z_sign + 0.0 * row_sign], axis=-1)
        points = corner * np.asarray(self.core) + self.rounding * normal
        points = np.concatenate([points, points[:, :1]], axis=1)
        # The pole's row is the outline of the top or bottom face: closed by a row at the face's centre.
        height = self.core[1] + self.rounding
        caps = [np.broadcast_to([0.0, sign * height, 0.0], (1, points.shape[1], 3)) for sign in (-1.0, 1.0)]
        return _densify(_densify(np.concatenate([caps[0], points, caps[1]]), rows, axis=0), columns, axis=1)

    @property
    def volume(self) -> float:
        """See `Shape`."""
        x, y, z = (2.0 * half for half in self.core)
        round_parts = np.pi * self.rounding**2 * (x + y + z) + 4.0 / 3.0 * np.pi * self.rounding**3
        return x * y * z + 2.0 * self.rounding * (x * y + y * z + z * x) + round_parts

    def sample(self, count: int, generator: RandomNumbers) -> Array:
        """See `Shape`."""
        if self.rounding > 0.0:
            return super().sample(count, generator)
        return generator.uniform(-0.5, 0.5, (count, 3)) * (2.0 * np.asarray(self.core))


def _densify(points: Array, count: int, *, axis: int) -> Array:
    """Put further points between the points along an axis, in proportion to the length of the gaps; the old ones are kept."""
    gaps = np.linalg.norm(np.diff(points, axis=axis), axis=-1).max(axis=1 - axis)
    extra = np.maximum(np.ceil(gaps / max(float(gaps.sum()), 1e-12) * count).astype(int), 1)
    old = np.arange(points.shape[axis], dtype=np.float64)
    new = np.concatenate([*(np.arange(n) / n + i for i, n in enumerate(extra)), old[-1:]])
    lower = np.minimum(new.astype(int), len(old) - 2)
    weight = (new - lower)[:, None, None] if axis == 0 else (new - lower)[None, :, None]
    return np.asarray((1.0 - weight) * np.take(points, lower, axis=axis) + weight * np.take(points, lower + 1, axis=axis))


class ToolBox(ToolBase):
    """A block of `half_extents` (3,), grown by `rounding` on all sides, length units."""

    kind: Literal["Box"] = "Box"
    half_extents: Lengths3
    rounding: Coordinate = Field(default=0.0, ge=0.0)

    def shape(self, *, gap: Tensor | float | None = None) -> ShapeBox:
        """See `ToolBase`."""
        return ShapeBox(self.half_extents, self.rounding)

    @property
    def kernel_lengths(self) -> tuple[float, ...]:
        """See `ToolBase`."""
        return (*self.half_extents, self.rounding)

    @property
    def thinnest_axis(self) -> int:
        """See `ToolBase`."""
        return self.half_extents.index(min(self.half_extents))


class BodyBox(BodyBase):
    """An axis-aligned block of clay. Attributes: widths (3,), full edges, length units; see `BodyBase` for the others."""

    kind: Literal["box"] = "box"
    widths: Lengths3

    def shape(self) -> ShapeBox:
        """See `BodyBase`."""
        return ShapeBox(self.half_extents)

    @property
    def half_extents(self) -> Vector3:
        """See `BodyBase`."""
        return (0.5 * self.widths[0], 0.5 * self.widths[1], 0.5 * self.widths[2])
