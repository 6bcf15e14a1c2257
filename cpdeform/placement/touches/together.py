"""Several tools, each with a touch of its own, at the same time."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

import numpy as np

from cpdeform.placement.touches.touch import Move, Room, Touch, Vector


@dataclasses.dataclass(frozen=True, kw_only=True)
class TouchTogether(Touch):
    """Touches of different tools.

    Attributes:
        parts: One for each tool that takes part.
    """

    name: ClassVar[str] = "together"
    parts: tuple[Touch, ...]

    @property
    def contact(self) -> Vector:  # type: ignore[override]
        """Contact point of the first part."""
        return self.parts[0].contact

    def moves(self, room: Room) -> dict[int, Move] | None:
        """See `Touch`."""
        found: dict[int, Move] = {}
        for part in self.parts:
            moves = part.moves(room)
            if moves is None:
                return None
            found |= moves
        return found

    def varied(self, generator: np.random.Generator, width: float) -> TouchTogether:
        """See `Touch`."""
        return TouchTogether(parts=tuple(part.varied(generator, width) for part in self.parts))


def label(touch: Touch) -> str:
    """A touch's name, those of its parts joined: ``"push+drag"``."""
    return "+".join(part.name for part in touch.parts) if isinstance(touch, TouchTogether) else touch.name
