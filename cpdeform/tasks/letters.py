"""Letters written by a pen: polylines that are pressed into a board."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from cpdeform.core.scene import Vector3
from cpdeform.tasks.scripts import Leg

Polyline = tuple[tuple[float, float], ...]
"""Corners (x, z) in length units; z grows towards the reader's own side, a letter's lower end."""

LETTERS: dict[str, tuple[Polyline, ...]] = {
    "I": (((0.0, 0.0), (0.0, 1.0)),),
    "C": (((1.0, 0.0), (0.3, 0.0), (0.0, 0.3), (0.0, 0.7), (0.3, 1.0), (1.0, 1.0)),),
    "L": (((0.0, 0.0), (0.0, 1.0), (1.0, 1.0)),),
    # The stem comes last: drawn first, it would be filled again by the clay that the bowl pushes aside.
    "R": (((0.0, 0.0), (0.7, 0.0), (1.0, 0.25), (0.7, 0.5), (0.0, 0.5)), ((0.4, 0.5), (1.0, 1.0)), ((0.0, 1.0), (0.0, 0.0))),
}
"""Strokes of each letter in a box of width and height 1."""

STEP_LENGTH = 0.008
"""How far the pen is drawn in an environment step, length units."""


def write(
    word: str, *, left: float, top: float, width: float, height: float, gap: float, pen_height: float, depth: float, scale: float
) -> list[Leg]:
    """The motion that writes a word.

    Args:
        word: Letters out of `LETTERS`.
        left: Where the first letter begins, along x, length units.
        top: Upper end of the letters, along z.
        width: Width of a letter; that of an I is none.
        height: Height of a letter.
        gap: Space between letters.
        pen_height: Height of the pen's centre above the board when it does not touch.
        depth: How deep the pen is pressed down from there.
        scale: The pen's action scale, length units per step at action 1.
    """
    legs: list[Leg] = []
    for letter in word:
        span = 0.0 if letter == "I" else width
        for stroke in LETTERS[letter]:
            corners = [(left + x * span, top + z * height) for x, z in stroke]
            legs += _stroke(corners, pen_height=pen_height, depth=depth, scale=scale)
        left += span + gap
    return legs


def draw(lines: Sequence[Sequence[tuple[float, float]]], *, pen_height: float, depth: float, scale: float) -> list[Leg]:
    """The motion that draws lines, each given by its corners (x, z) in length units; the other arguments are as for `write`."""
    return [leg for corners in lines for leg in _stroke(corners, pen_height=pen_height, depth=depth, scale=scale)]


def _stroke(corners: Sequence[tuple[float, float]], *, pen_height: float, depth: float, scale: float) -> list[Leg]:
    """Down, along the corners, and up again."""
    steps = int(np.ceil(depth / STEP_LENGTH))
    vertical = depth / steps / scale
    start: Vector3 = (corners[0][0], pen_height, corners[0][1])
    legs = [Leg(steps, {0: (0.0, -vertical, 0.0)}, {0: start})]
    for (x, z), (next_x, next_z) in itertools.pairwise(corners):
        count = max(1, round(float(np.hypot(next_x - x, next_z - z)) / STEP_LENGTH))
        legs.append(Leg(count, {0: ((next_x - x) / count / scale, 0.0, (next_z - z) / count / scale)}))
    return [*legs, Leg(steps, {0: (0.0, vertical, 0.0)})]
