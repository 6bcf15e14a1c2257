"""Random figures in the plane: polygons that are joined, and polygons that are cut out of them.

All have a size of about 1 around the origin. The second coordinate grows towards the figure's lower end, as z does on the floor for
somebody who reads from above.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from cpdeform.core.scene import Vector3
from cpdeform.tasks.solids import Primitive, Prism

Point = tuple[float, float]
Outline = tuple[Point, ...]

ROUND_CORNERS = 32
"""Corners of the polygon that stands for a circle."""


@dataclasses.dataclass(frozen=True)
class Figure:
    """A figure in the plane.

    Attributes:
        joined: Polygons whose union it is.
        cut: Polygons that are taken away.
    """

    joined: tuple[Outline, ...]
    cut: tuple[Outline, ...] = ()

    def turned(self, angle: float) -> Figure:
        """The figure, turned about the origin by an angle in radians."""
        return Figure(*(tuple(moved(outline, angle=angle) for outline in part) for part in (self.joined, self.cut)))


@dataclasses.dataclass(frozen=True)
class Cut:
    """What is in one of `whole` and in none of `taken`."""

    whole: tuple[Primitive, ...]
    taken: tuple[Primitive, ...]

    @property
    def corners(self) -> tuple[Vector3, Vector3]:
        """See `Primitive`."""
        lower = np.min([part.corners[0] for part in self.whole], axis=0)
        upper = np.max([part.corners[1] for part in self.whole], axis=0)
        (a, b, c), (d, e, f) = lower.tolist(), upper.tolist()
        return (a, b, c), (d, e, f)

    def contains(self, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        """See `Primitive`."""
        inside = np.logical_or.reduce([part.contains(points) for part in self.whole])
        for part in self.taken:
            inside &= ~part.contains(points)
        return np.asarray(inside)


@dataclasses.dataclass(frozen=True)
class Upright:
    """A primitive whose y and z are exchanged: what lay on the floor stands on it."""

    lying: Primitive

    @property
    def corners(self) -> tuple[Vector3, Vector3]:
        """See `Primitive`."""
        (a, b, c), (d, e, f) = self.lying.corners
        return (a, c, b), (d, f, e)

    def contains(self, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        """See `Primitive`."""
        return self.lying.contains(points[:, [0, 2, 1]])


def prisms(figure: Figure, low: float, high: float, *, centre: Point = (0.5, 0.5)) -> Primitive:
    """The figure as a slab between two heights, its origin at `centre`, length units."""
    made = [[Prism(moved(outline, by=centre), low, high) for outline in part] for part in (figure.joined, figure.cut)]
    return Cut(tuple(made[0]), tuple(made[1]))


def moved(outline: Outline, *, by: Point = (0.0, 0.0), angle: float = 0.0, scale: float = 1.0) -> Outline:
    """An outline, scaled and turned about the origin, then shifted."""
    c, s = scale * math.cos(angle), scale * math.sin(angle)
    return tuple((c * x - s * z + by[0], s * x + c * z + by[1]) for x, z in outline)


def ellipse(centre: Point, width: float, height: float) -> Outline:
    """An ellipse with the given semi-axes."""
    angles = [2.0 * math.pi * number / ROUND_CORNERS for number in range(ROUND_CORNERS)]
    return tuple((centre[0] + width * math.cos(angle), centre[1] + height * math.sin(angle)) for angle in angles)


def box(x_low: float, z_low: float, x_high: float, z_high: float) -> Outline:
    """An axis-aligned rectangle."""
    return ((x_low, z_low), (x_high, z_low), (x_high, z_high), (x_low, z_high))


def stroke(first: Point, second: Point, width: float) -> tuple[Outline, ...]:
    """A line with round ends."""
    along = np.subtract(second, first)
    aside = 0.5 * width * np.array([-along[1], along[0]]) / max(float(np.hypot(*along)), 1e-9)
    corners = [np.add(first, aside), np.add(second, aside), np.subtract(second, aside), np.subtract(first, aside)]
    caps = [ellipse(end, 0.5 * width, 0.5 * width) for end in (first, second)]
    return (tuple((float(x), float(z)) for x, z in corners), *caps)


def lines(corners: Sequence[Point], width: float) -> tuple[Outline, ...]:
    """A polyline with round ends and corners."""
    return tuple(part for pair in itertools.pairwise(corners) for part in stroke(*pair, width))


def _star(rng: np.random.Generator) -> Figure:
    tips = int(rng.integers(4, 7))
    notch, blunt = rng.uniform(0.26, 0.32), rng.uniform(0.05, 0.08)
    outline: list[Point] = []
    for number in range(tips):
        angle = 2.0 * math.pi * number / tips
        corners = ((-blunt, -0.5), (blunt, -0.5))
        outline += moved(corners, angle=angle)
        outline += moved(((0.0, -notch),), angle=angle + math.pi / tips)
    return Figure((tuple(outline),))


def _cross(rng: np.random.Generator) -> Figure:
    arms, width = int(rng.integers(3, 6)), rng.uniform(0.25, 0.34)
    ends = [moved(((0.0, -0.5),), angle=2.0 * math.pi * number / arms)[0] for number in range(arms)]
    return Figure(tuple(part for end in ends for part in stroke((0.0, 0.0), end, width)))


def _flower(rng: np.random.Generator) -> Figure:
    petals = int(rng.integers(3, 6))
    size = rng.uniform(0.18, 0.2) * (1.2 if petals < 5 else 1.0)
    centres = [moved(((0.0, -0.3),), angle=2.0 * math.pi * number / petals)[0] for number in range(petals)]
    return Figure((ellipse((0.0, 0.0), 0.22, 0.22), *(ellipse(centre, size, size) for centre in centres)))


def _heart(rng: np.random.Generator) -> Figure:
    lobe, depth = rng.uniform(0.26, 0.29), rng.uniform(0.42, 0.55)
    point = ((-0.475, -0.02), (0.475, -0.02), (0.05, depth), (-0.05, depth))
    return Figure((ellipse((-0.24, -0.15), lobe, lobe), ellipse((0.24, -0.15), lobe, lobe), point))


def _crescent(rng: np.random.Generator) -> Figure:
    away = rng.uniform(0.26, 0.32)
    return Figure((ellipse((0.0, 0.0), 0.5, 0.5),), (ellipse((away, 0.0), 0.36, 0.34),))


def _fish(rng: np.random.Generator) -> Figure:
    high, tail = rng.uniform(0.22, 0.28), rng.uniform(0.2, 0.26)
    return Figure((ellipse((-0.12, 0.0), 0.4, high), ((0.14, 0.06), (0.14, -0.06), (0.52, -tail), (0.44, 0.0), (0.52, tail))))


def _house(rng: np.random.Generator) -> Figure:
    eaves, ridge = rng.uniform(0.4, 0.48), rng.uniform(0.42, 0.52)
    roof = ((-eaves, -0.1), (eaves, -0.1), (0.05, -ridge), (-0.05, -ridge))
    walls = box(-0.3, -0.12, 0.3, 0.42)
    chimney = (box(0.14, -ridge + 0.02, 0.3, -0.1),) if rng.random() < 0.4 else ()
    return Figure((roof, walls, *chimney))


def _fir(rng: np.random.Generator) -> Figure:
    levels, width = 2, rng.uniform(0.36, 0.44)
    parts: list[Outline] = [box(-0.1, 0.3, 0.1, 0.55)]
    for level in range(levels):
        low, half = 0.36 - 0.38 * level, width * (1.0 - 0.28 * level)
        parts.append(((-half, low), (half, low), (0.05, low - 0.5), (-0.05, low - 0.5)))
    return Figure(tuple(parts))


def _arrow(rng: np.random.Generator) -> Figure:
    head, shaft = rng.uniform(0.32, 0.42), rng.uniform(0.13, 0.18)
    return Figure((((-head, -0.05), (head, -0.05), (0.05, -0.5), (-0.05, -0.5)), box(-shaft, -0.1, shaft, 0.5)))


def _figure_of_a_man(rng: np.random.Generator) -> Figure:
    arms, legs = rng.uniform(-0.16, 0.12), rng.uniform(0.18, 0.26)
    width = rng.uniform(0.19, 0.22)
    parts = [ellipse((0.0, -0.38), 0.17, 0.17), *stroke((0.0, -0.3), (0.0, 0.1), 0.3)]
    for side in (-1.0, 1.0):
        parts += [*stroke((0.0, -0.1), (side * 0.42, -0.08 - arms), width), *stroke((0.0, 0.1), (side * legs, 0.5), width)]
    return Figure(tuple(parts))


def _drop(rng: np.random.Generator) -> Figure:
    radius, tip = rng.uniform(0.3, 0.36), rng.uniform(0.45, 0.6)
    return Figure((ellipse((0.0, 0.15), radius, radius), ((-radius, 0.1), (radius, 0.1), (0.05, -tip), (-0.05, -tip))))


def _bone(rng: np.random.Generator) -> Figure:
    knob, away = rng.uniform(0.17, 0.2), rng.uniform(0.13, 0.16)
    knobs = [ellipse((x, z), knob, knob) for x in (-0.4, 0.4) for z in (-away, away)]
    return Figure((box(-0.4, -0.13, 0.4, 0.13), *knobs))


def _airplane(rng: np.random.Generator) -> Figure:
    span, sweep, tail = rng.uniform(0.42, 0.52), rng.uniform(0.0, 0.18), rng.uniform(0.2, 0.28)
    parts = [*stroke((0.0, -0.45), (0.0, 0.4), 0.24)]
    for side in (-1.0, 1.0):
        wing = ((0.0, -0.18), (0.0, 0.14), (side * span, 0.12 + sweep), (side * span, -0.06 + sweep))
        parts += [wing, ((0.0, 0.3), (0.0, 0.52), (side * tail, 0.52), (side * tail, 0.36))]
    return Figure(tuple(parts))


LETTER_LINES: Mapping[str, tuple[tuple[Point, ...], ...]] = MappingProxyType(
    {
        "C": (((0.8, 0.05), (0.35, 0.0), (0.0, 0.3), (0.0, 0.7), (0.35, 1.0), (0.8, 0.95)),),
        "F": (((0.0, 1.0), (0.0, 0.0), (0.8, 0.0)), ((0.0, 0.52), (0.6, 0.52))),
        "H": (((0.0, 0.0), (0.0, 1.0)), ((0.8, 0.0), (0.8, 1.0)), ((0.0, 0.5), (0.8, 0.5))),
        "J": (((0.7, 0.0), (0.7, 0.75), (0.4, 1.0), (0.0, 0.85)),),
        "K": (((0.0, 0.0), (0.0, 1.0)), ((0.8, 0.0), (0.1, 0.5), (0.8, 1.0))),
        "L": (((0.0, 0.0), (0.0, 1.0), (0.7, 1.0)),),
        "N": (((0.0, 1.0), (0.0, 0.0), (0.8, 1.0), (0.8, 0.0)),),
        "S": (((0.75, 0.0), (0.15, 0.0), (0.0, 0.2), (0.15, 0.45), (0.6, 0.55), (0.75, 0.8), (0.6, 1.0), (0.0, 1.0)),),
        "T": (((0.0, 0.0), (0.9, 0.0)), ((0.45, 0.0), (0.45, 1.0))),
        "U": (((0.0, 0.0), (0.0, 0.8), (0.2, 1.0), (0.6, 1.0), (0.8, 0.8), (0.8, 0.0)),),
        "V": (((0.0, 0.0), (0.4, 1.0), (0.8, 0.0)),),
        "X": (((0.0, 0.0), (0.8, 1.0)), ((0.8, 0.0), (0.0, 1.0))),
        "Y": (((0.0, 0.0), (0.4, 0.5), (0.8, 0.0)), ((0.4, 0.5), (0.4, 1.0))),
        "Z": (((0.0, 0.0), (0.75, 0.0), (0.0, 1.0), (0.75, 1.0)),),
    }
)
"""Strokes of letters in a box about 0.8 wide and 1 high."""


def _letter(rng: np.random.Generator) -> Figure:
    name = list(LETTER_LINES)[rng.integers(len(LETTER_LINES))]
    width = rng.uniform(0.24, 0.3)
    parts = [part for line in LETTER_LINES[name] for part in lines([(x - 0.4, z - 0.5) for x, z in line], width)]
    return Figure(tuple(parts))


FIGURES: Mapping[str, Callable[[np.random.Generator], Figure]] = MappingProxyType(
    {
        "star": _star,
        "cross": _cross,
        "flower": _flower,
        "heart": _heart,
        "crescent": _crescent,
        "fish": _fish,
        "house": _house,
        "fir": _fir,
        "arrow": _arrow,
        "man": _figure_of_a_man,
        "drop": _drop,
        "bone": _bone,
        "airplane": _airplane,
        "letter": _letter,
    }
)
"""Makers of figures."""
