"""A stroke: a tool comes down on the clay and draws a groove."""

from __future__ import annotations

import dataclasses
from typing import ClassVar, Self

import numpy as np
import torch

from cpdeform.placement.touches.touch import Move, Room, TouchSingle, facing, scaled, unit


@dataclasses.dataclass(frozen=True, kw_only=True)
class TouchStroke(TouchSingle):
    """One tool presses into the clay from above at the contact, then moves along the part of the direction on the level.

    Attributes:
        depth: How far the tool comes down before, length units.
    """

    name: ClassVar[str] = "stroke"
    depth: float

    def moves(self, room: Room) -> dict[int, Move] | None:
        """See `Touch`."""
        down = room.particles.new_tensor([0.0, -1.0, 0.0])
        along = unit(self.direction * np.array([1.0, 0.0, 1.0]), room.particles)
        rotation = facing(room.scene.tools[self.tool], down, edge=False, roll=0.0)
        pose = room.behind(self.tool, rotation, torch.as_tensor(self.contact).to(down), down)
        return None if pose is None else {self.tool: Move(pose, self.depth * down, self.way * along)}

    def varied(self, generator: np.random.Generator, width: float) -> Self:
        """See `Touch`."""
        near = super().varied(generator, width)
        return dataclasses.replace(near, depth=scaled(self.depth, generator, width))
