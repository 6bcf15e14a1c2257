"""A pinch: two tools beside the clay close in a V and pull it along."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

import numpy as np
import torch

from cpdeform.core.rotation import rotate
from cpdeform.placement.touches.touch import (
    Move,
    Room,
    Touch,
    Vector,
    aside,
    facing,
    moved,
    scaled,
    turn_about,
    turned_aside,
    unit,
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class TouchPinch(Touch):
    """Two tools on opposite sides of a contact point close towards each other and pull.

    Attributes:
        tools: Indices of the two tools.
        contact: Contact point (3,), length units.
        direction: Where they pull (3,); the V is open towards where they come from.
        side: The plane that they close in, an angle about the direction, radians; see `aside`.
        tilts: How far each is turned out of the parallel, radians.
        closings: How far each closes in, length units.
        pull: How far they pull, length units.
    """

    name: ClassVar[str] = "pinch"
    tools: tuple[int, int]
    contact: Vector
    direction: Vector
    side: float
    tilts: tuple[float, float]
    closings: tuple[float, float]
    pull: float

    def moves(self, room: Room) -> dict[int, Move] | None:
        """See `Touch`."""
        direction = unit(self.direction, room.particles)
        across, contact = aside(direction, self.side), torch.as_tensor(self.contact).to(room.particles)
        axis = torch.linalg.cross(direction, across)
        found: dict[int, Move] = {}
        for index, sign, tilt, closing in zip(self.tools, (1.0, -1.0), self.tilts, self.closings, strict=True):
            inward = rotate(turn_about(axis, sign * tilt), -sign * across)
            rotation = facing(room.scene.tools[index], inward, edge=False, roll=0.0)
            pose = room.behind(index, rotation, contact, inward)
            if pose is None:
                return None
            found[index] = Move(pose, closing * inward + self.pull * direction)
        return found

    def varied(self, generator: np.random.Generator, width: float) -> TouchPinch:
        """See `Touch`."""
        first, second = self.tilts + 0.12 * width * generator.standard_normal(2)
        return dataclasses.replace(
            self,
            contact=moved(self.contact, generator, width),
            direction=turned_aside(self.direction, generator, width),
            side=self.side + 0.12 * width * float(generator.standard_normal()),
            tilts=(float(first), float(second)),
            closings=(scaled(self.closings[0], generator, width), scaled(self.closings[1], generator, width)),
            pull=max(0.0, self.pull + 0.012 * width * float(generator.standard_normal())),
        )
