"""A squeeze: two tools on opposite sides of the clay close towards each other, along the way that the clay has to go."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

import numpy as np
import torch

from cpdeform.core.rotation import rotate
from cpdeform.placement.touches.touch import Move, Room, Touch, Vector, aside, facing, moved, scaled, turn_about, turned_aside, unit


@dataclasses.dataclass(frozen=True, kw_only=True)
class TouchSqueeze(Touch):
    """One tool pushes the clay where it has to go, another one holds or pushes against it from the far side.

    A body that stands, and that one tool alone would topple or carry away, becomes thinner between two.

    Attributes:
        tools: Indices of the two tools; the first is on the contact's side.
        contact: Contact point (3,), length units.
        direction: Where the first one pushes (3,).
        tilts: How far each is turned about the axis across the direction, radians.
        closings: How far each goes, length units.
        edge: Whether flat tools push with their edges.
        roll: Angle of flat tools about the direction, radians.
    """

    name: ClassVar[str] = "squeeze"
    tools: tuple[int, int]
    contact: Vector
    direction: Vector
    tilts: tuple[float, float]
    closings: tuple[float, float]
    edge: bool = False
    roll: float = 0.0

    def moves(self, room: Room) -> dict[int, Move] | None:
        """See `Touch`."""
        direction, contact = unit(self.direction, room.particles), torch.as_tensor(self.contact).to(room.particles)
        axis = aside(direction, 0.5 * np.pi)
        found: dict[int, Move] = {}
        for index, sign, tilt, closing in zip(self.tools, (1.0, -1.0), self.tilts, self.closings, strict=True):
            inward = rotate(turn_about(axis, sign * tilt), sign * direction)
            rotation = facing(room.scene.tools[index], inward, edge=self.edge, roll=self.roll)
            pose = room.behind(index, rotation, contact, inward)
            if pose is None:
                return None
            found[index] = Move(pose, closing * inward)
        return found

    def varied(self, generator: np.random.Generator, width: float) -> TouchSqueeze:
        """See `Touch`."""
        first, second = self.tilts + 0.12 * width * generator.standard_normal(2)
        return dataclasses.replace(
            self,
            contact=moved(self.contact, generator, width),
            direction=turned_aside(self.direction, generator, width),
            tilts=(float(first), float(second)),
            closings=(scaled(self.closings[0], generator, width), scaled(self.closings[1], generator, width)),
            roll=self.roll + 0.12 * width * float(generator.standard_normal()),
        )
