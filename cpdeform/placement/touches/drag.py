"""A drag along a side: friction takes the clay with it."""

from __future__ import annotations

import dataclasses
from typing import ClassVar, Self

import numpy as np
import torch

from cpdeform.placement.touches.touch import Move, Room, TouchSingle, aside, facing, scaled, unit


@dataclasses.dataclass(frozen=True, kw_only=True)
class TouchDrag(TouchSingle):
    """One tool beside the clay closes in a little and moves along.

    Attributes:
        side: On which side it is, an angle about the direction, radians; see `aside`.
        closing: How far it closes in, length units.
    """

    name: ClassVar[str] = "drag"
    side: float
    closing: float

    def moves(self, room: Room) -> dict[int, Move] | None:
        """See `Touch`."""
        direction = unit(self.direction, room.particles)
        inward = -aside(direction, self.side)
        rotation = facing(room.scene.tools[self.tool], inward, edge=False, roll=0.0)
        pose = room.behind(self.tool, rotation, torch.as_tensor(self.contact).to(direction), inward)
        return None if pose is None else {self.tool: Move(pose, self.way * direction + self.closing * inward)}

    def varied(self, generator: np.random.Generator, width: float) -> Self:
        """See `Touch`."""
        near = super().varied(generator, width)
        side = self.side + 0.12 * width * float(generator.standard_normal())
        return dataclasses.replace(near, side=side, closing=scaled(self.closing, generator, width))
