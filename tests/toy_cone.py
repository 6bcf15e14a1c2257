"""A kind of tool that cpdeform does not have, in one file like those of `cpdeform.core.shapes`."""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING, Literal

import numpy as np

from cpdeform.core.model import PositiveFloat
from cpdeform.core.scene import Scene, Tool
from cpdeform.core.shapes.base import Array, Shape
from cpdeform.core.shapes.lengths import along_and_across, length
from cpdeform.core.shapes.meshes import revolve
from cpdeform.core.shapes.tool import ToolBase

if TYPE_CHECKING:
    from torch import Tensor


@dataclasses.dataclass(frozen=True)
class ShapeCone(Shape):
    """A cone about the y axis: its base at -height/2, its tip at height/2."""

    radius: float
    height: float

    def distance(self, x: Tensor, y: Tensor, z: Tensor) -> Tensor:
        flat, below, slant = length(x, z), -0.5 * self.height - y, math.hypot(self.radius, self.height)
        to_base = length((flat - self.radius).clamp(min=0.0), below)
        share = ((self.radius - flat) * self.radius - below * self.height) / slant**2
        share = share.clamp(0.0, 1.0)
        to_side = length(flat - self.radius * (1.0 - share), -below - self.height * share)
        beside = ((flat - self.radius) * self.height - below * self.radius) / slant
        inside = beside.maximum(below) < 0.0
        nearest = to_base.minimum(to_side)
        return (-nearest).where(inside, nearest)

    def half_extents(self, axes: Tensor) -> Tensor:
        along, across = along_and_across(axes)
        return along * (0.5 * self.height) + across * self.radius

    def surface(self, *, rows: int, columns: int) -> Array:
        profile = np.array([[0.0, -0.5 * self.height], [self.radius, -0.5 * self.height], [0.0, 0.5 * self.height]])
        return revolve(profile, rows=rows, columns=columns)

    @property
    def volume(self) -> float:
        return math.pi / 3.0 * self.radius**2 * self.height


class ToolCone(ToolBase):
    kind: Literal["Cone"] = "Cone"
    radius: PositiveFloat
    height: PositiveFloat

    def shape(self, *, gap: Tensor | float | None = None) -> ShapeCone:
        return ShapeCone(self.radius, self.height)

    @property
    def kernel_lengths(self) -> tuple[float, ...]:
        return (self.radius, self.height)


class SceneWithCones(Scene):
    """What an entry in the list of `cpdeform.core.shapes.kinds` does for `Scene`."""

    tools: tuple[Tool | ToolCone, ...] = ()
