"""A stroke: a tool comes down on the clay and draws a groove."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

import numpy as np
import torch

from cpdeform.placement.touches.touch import Move, Room, Touch, Vector, facing, moved, scaled, turned_aside, unit


@dataclasses.dataclass(frozen=True, kw_only=True)
class TouchStroke(Touch):
    """One tool presses into the clay from above, then moves along a line on the level.

    Attributes:
        tool: Index of the tool.
        contact: Where the groove begins (3,), length units.
        direction: Where it goes (3,); its part on the level counts.
        way: How far it goes, length units.
        depth: How far the tool comes down before, length units.
    """

    name: ClassVar[str] = "stroke"
    tool: int
    contact: Vector
    direction: Vector
    way: float
    depth: float

    def moves(self, room: Room) -> dict[int, Move] | None:
        """See `Touch`."""
        down = room.particles.new_tensor([0.0, -1.0, 0.0])
        along = unit(self.direction * np.array([1.0, 0.0, 1.0]), room.particles)
        rotation = facing(room.scene.tools[self.tool], down, edge=False, roll=0.0)
        pose = room.behind(self.tool, rotation, torch.as_tensor(self.contact).to(down), down)
        return None if pose is None else {self.tool: Move(pose, self.depth * down, self.way * along)}

    def varied(self, generator: np.random.Generator, width: float) -> TouchStroke:
        """See `Touch`."""
        return dataclasses.replace(
            self,
            contact=moved(self.contact, generator, width),
            direction=turned_aside(self.direction, generator, width),
            way=scaled(self.way, generator, width),
            depth=scaled(self.depth, generator, width),
        )
