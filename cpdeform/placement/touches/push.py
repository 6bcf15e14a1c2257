"""A push along a direction, or from above: a press."""

from __future__ import annotations

import dataclasses
from typing import ClassVar, Self

import numpy as np
import torch

from cpdeform.placement.touches.touch import Move, Room, TouchSingle, facing, unit


@dataclasses.dataclass(frozen=True, kw_only=True)
class TouchPush(TouchSingle):
    """One tool pushes the clay around a contact point, with its broad face or its edge.

    Attributes:
        edge: Whether a flat tool pushes with its edge.
        roll: Angle of a flat tool about the direction, radians.
    """

    name: ClassVar[str] = "push"
    edge: bool = False
    roll: float = 0.0

    def moves(self, room: Room) -> dict[int, Move] | None:
        """See `Touch`."""
        direction = unit(self.direction, room.particles)
        rotation = facing(room.scene.tools[self.tool], direction, edge=self.edge, roll=self.roll)
        pose = room.behind(self.tool, rotation, torch.as_tensor(self.contact).to(direction), direction)
        return None if pose is None else {self.tool: Move(pose, self.way * direction)}

    def varied(self, generator: np.random.Generator, width: float) -> Self:
        """See `Touch`."""
        near = super().varied(generator, width)
        return dataclasses.replace(near, roll=self.roll + 0.12 * width * float(generator.standard_normal()))


@dataclasses.dataclass(frozen=True, kw_only=True)
class TouchPress(TouchPush):
    """A push straight down."""

    name: ClassVar[str] = "press"
