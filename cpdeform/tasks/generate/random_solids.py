"""Random solids of the clay's volume: flat figures for slabs, standing ones for blocks.

A solid is drawn again until tools can make it: nothing in it, and no gap, is thinner than a tool, and it reaches no farther beyond
the clay's start than the shipped goals do.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from cpdeform.core.errors import InputError
from cpdeform.core.scene import WALL_NODES, Scene
from cpdeform.tasks.generate.outlines import FIGURES, Cut, Upright, box, moved, prisms
from cpdeform.tasks.solids import Block, Ellipsoid, Primitive, Prism, Solid, Turned, body_volume

TOOL = 0.05
"""Thickness of the tools, length units: of a feature or a gap, at least."""

LOST_SHARE = 0.08
"""Share of the volume that may be thinner than a tool, and as much of it in narrower gaps: tips and corners."""

REACH = 0.11
"""How far a solid may reach beyond the clay's start at each side, length units."""

FLAT = 0.5
"""Height of the clay over its width below which figures lie on the floor."""

ABOVE = 0.003
"""Height over the floor at which a solid is made, length units; it is put down to rest later."""

MARGIN = 0.08
"""Distance from the domain's faces, length units."""

ATTEMPTS = 25
"""Tries with one kind of solid."""

VOXELS = 72
"""Voxels along the longest edge, to look for thin places."""

Maker = Callable[[np.random.Generator, Scene], Solid]


def rest_height(scene: Scene) -> float:
    """Height that clay rests at, length units: the floor's boundary layer, or the bodies' own lower end where it is inside that."""
    nodes = WALL_NODES + math.floor(scene.ground_height * scene.grid_size)
    return min(nodes * scene.node_distance, min(body.position[1] - body.half_extents[1] for body in scene.bodies))


def random_solid(scene: Scene, rng: np.random.Generator) -> tuple[str, Solid]:
    """A random solid that the scene's clay can be made into.

    Args:
        scene: Its clay gives volume and place; a flat slab gets a flat figure.
        rng: Where random numbers come from.

    Returns:
        What it is, such as ``"flat heart"``, and the solid, fitted to the clay's volume.

    Raises:
        InputError: No solid was found: the clay is too small or too large for the tools.
    """
    lower, upper = _extent(scene)
    widths = upper - lower
    volume = sum(body_volume(body) for body in scene.bodies)
    makers = _FLAT if widths[1] < FLAT * min(widths[0], widths[2]) else _STANDING
    names = list(makers)
    # A kind is given several tries before the next one: those that are hard to fit would be rare otherwise.
    for number in rng.permutation(len(names)):
        for _ in range(ATTEMPTS):
            solid = makers[names[number]](rng, scene).fitted_to(volume)
            low, high = solid.corners
            sideways = (low < lower - REACH)[[0, 2]].any() or (high > upper + REACH)[[0, 2]].any()
            # Thinner than a tool throughout: no need to look closer, at more voxels the smaller the solid is.
            if (high - low).min() < TOOL:
                continue
            if sideways or high[1] > upper[1] + REACH or low[0] < MARGIN or low[2] < MARGIN or high.max() > 1.0 - MARGIN:
                continue
            if max(thin_shares(solid)) <= LOST_SHARE:
                return names[number], solid
    remedy = "Scenes such as star or chair have clay for solids."
    raise InputError("scene", came="clay of which no solid could be made", expected="a slab or a block", remedy=remedy)


def thin_shares(solid: Solid, *, thickness: float = TOOL) -> tuple[float, float]:
    """How much of a solid, and how much room in its gaps, no ball of a diameter fits into, over the solid's volume.

    Morphological opening and closing on a grid of voxels; the floor is no gap.

    Args:
        solid: The solid.
        thickness: Diameter of the ball, length units.
    """
    from scipy.ndimage import distance_transform_edt

    lower, upper = solid.corners
    size = float((upper - lower).max()) / VOXELS
    margin = math.ceil(thickness / size) + 2
    counts = np.ceil((upper - lower) / size).astype(int) + 2 * margin
    axes = [low + (np.arange(count) - margin + 0.5) * size for low, count in zip(lower, counts, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    inside = solid.contains(points).reshape(counts)
    radius = 0.5 * thickness / size

    def opened(cells: NDArray[np.bool_]) -> NDArray[np.bool_]:
        core = distance_transform_edt(cells) > radius
        return np.asarray((distance_transform_edt(~core) <= radius) & cells)

    volume = float(inside.sum())
    thin = float((inside & ~opened(inside)).sum()) / volume
    # Below the solid there is the floor, which no tool has to get into.
    outside = ~inside
    outside[:, :margin] = True
    gaps = float((outside & ~opened(outside))[:, margin:].sum()) / volume
    return thin, gaps


def _extent(scene: Scene) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Corners of a box around the clay, as it rests on the floor."""
    centres, halves = (np.array([getattr(body, name) for body in scene.bodies]) for name in ("position", "half_extents"))
    lower, upper = (centres - halves).min(axis=0), (centres + halves).max(axis=0)
    drop = lower[1] - rest_height(scene)
    return lower - [0.0, drop, 0.0], upper - [0.0, drop, 0.0]


def _place(scene: Scene) -> tuple[float, float, float]:
    """Middle of the clay on the floor, where solids stand: x, height, z."""
    lower, upper = _extent(scene)
    return float(0.5 * (lower[0] + upper[0])), float(lower[1]) + ABOVE, float(0.5 * (lower[2] + upper[2]))


def _flat(name: str) -> Maker:
    def make(rng: np.random.Generator, scene: Scene) -> Solid:
        lower, upper = _extent(scene)
        x, floor, z = _place(scene)
        figure = FIGURES[name](rng).turned(rng.uniform(0.0, 2.0 * math.pi))
        height = float(upper[1] - lower[1]) * rng.uniform(0.95, 1.15)
        return Solid(parts=(prisms(figure, floor, floor + height, centre=(x, z)),), origin=(x, floor, z), scaled_axes=(0, 2))

    return make


def _standing_figure(make_outline: Callable[[np.random.Generator], tuple[tuple[tuple[float, float], ...], ...]]) -> Maker:
    """Outlines (x, height), height 0 at the floor, drawn out along z."""

    def make(rng: np.random.Generator, scene: Scene) -> Solid:
        lower, upper = _extent(scene)
        x, floor, z = _place(scene)
        depth = float(upper[2] - lower[2]) * rng.uniform(0.8, 1.05)
        height = float(upper[1] - lower[1])
        outlines = tuple(moved(outline, scale=height, by=(x, floor)) for outline in make_outline(rng))
        from_above = prisms_between(outlines, z - 0.5 * depth, z + 0.5 * depth)
        return Solid(parts=(Upright(from_above),), origin=(x, floor, z))

    return make


def prisms_between(outlines: tuple[tuple[tuple[float, float], ...], ...], low: float, high: float) -> Primitive:
    """The union of prisms over outlines that are in place already."""
    return Cut(tuple(Prism(outline, low, high) for outline in outlines), ())


def _stairs(rng: np.random.Generator) -> tuple[tuple[tuple[float, float], ...], ...]:
    steps = int(rng.integers(2, 4))
    return tuple(box(-0.5 + number / steps, 0.0, 0.5, 0.3 + 0.7 * number / (steps - 1)) for number in range(steps))


def _seat(rng: np.random.Generator) -> tuple[tuple[tuple[float, float], ...], ...]:
    back, seat = rng.uniform(0.28, 0.36), rng.uniform(0.4, 0.55)
    return box(-0.5, 0.0, 0.5, seat), box(-0.5, 0.0, -0.5 + back, rng.uniform(1.0, 1.2))


def _trough(rng: np.random.Generator) -> tuple[tuple[tuple[float, float], ...], ...]:
    wall, ground = rng.uniform(0.27, 0.34), rng.uniform(0.35, 0.5)
    return box(-0.55, 0.0, 0.55, ground), box(-0.55, 0.0, -0.55 + wall, 1.0), box(0.55 - wall, 0.0, 0.55, 1.0)


def _upright_house(rng: np.random.Generator) -> tuple[tuple[tuple[float, float], ...], ...]:
    walls, ridge = rng.uniform(0.5, 0.65), rng.uniform(1.05, 1.25)
    return box(-0.42, 0.0, 0.42, walls), ((-0.45, walls - 0.01), (0.45, walls - 0.01), (0.06, ridge), (-0.06, ridge))


def _tower_block(rng: np.random.Generator) -> tuple[tuple[tuple[float, float], ...], ...]:
    base, waist = rng.uniform(0.35, 0.5), rng.uniform(0.22, 0.28)
    return box(-0.5, 0.0, 0.5, base), box(-waist, 0.0, waist, rng.uniform(1.0, 1.25))


def _ramp(rng: np.random.Generator) -> tuple[tuple[tuple[float, float], ...], ...]:
    low = rng.uniform(0.2, 0.35)
    return (((-0.6, 0.0), (0.55, 0.0), (0.55, rng.uniform(0.95, 1.15)), (0.2, 0.95), (-0.6, low)),)


def _turned(rng: np.random.Generator, scene: Scene) -> Solid:
    """A vase, bottle, pawn or hourglass: radii between a few heights, none much wider than the one below it."""
    lower, upper = _extent(scene)
    x, floor, z = _place(scene)
    tall = float(upper[1] - lower[1])
    radius = 0.5 * float(min(upper[0] - lower[0], upper[2] - lower[2]))
    rings = int(rng.integers(3, 6))
    heights = np.linspace(0.0, tall * rng.uniform(0.95, 1.2), rings + 1)
    radii = radius * rng.uniform(0.5, 1.25, rings + 1)
    radii[0] = radius * rng.uniform(0.9, 1.2)  # it has to stand
    profile = tuple((floor + float(height), max(float(value), 0.035)) for height, value in zip(heights, radii, strict=True))
    return Solid(parts=(Turned((x, z), profile),), origin=(x, floor, z))


def _bottle(rng: np.random.Generator, scene: Scene) -> Solid:
    lower, upper = _extent(scene)
    x, floor, z = _place(scene)
    tall, radius = float(upper[1] - lower[1]), 0.5 * float(min(upper[0] - lower[0], upper[2] - lower[2]))
    neck, shoulder = radius * rng.uniform(0.55, 0.7), tall * rng.uniform(0.45, 0.65)
    top = tall * rng.uniform(1.0, 1.2)
    profile = ((0.0, 1.15 * radius), (shoulder, 1.15 * radius), (shoulder + 0.6 * radius, neck), (top, neck))
    return Solid(parts=(Turned((x, z), tuple((floor + height, value) for height, value in profile)),), origin=(x, floor, z))


def _bowl(rng: np.random.Generator, scene: Scene) -> Solid:
    lower, upper = _extent(scene)
    x, floor, z = _place(scene)
    tall, radius = float(upper[1] - lower[1]), 0.5 * float(min(upper[0] - lower[0], upper[2] - lower[2]))
    rim = radius * rng.uniform(1.1, 1.3)
    inner = rim - rng.uniform(0.055, 0.065)
    depth = tall * rng.uniform(0.3, 0.55)
    whole = Turned((x, z), ((floor, 0.85 * radius), (floor + tall, rim)))
    hollow = Turned((x, z), ((floor + tall - depth, 0.6 * inner), (floor + tall + 0.1, inner)))
    return Solid(parts=(Cut((whole,), (hollow,)),), origin=(x, floor, z))


def _figurine(rng: np.random.Generator, scene: Scene) -> Solid:
    """A snowman, or a bust: a head on a body on a foot."""
    lower, upper = _extent(scene)
    x, floor, z = _place(scene)
    tall, radius = float(upper[1] - lower[1]), 0.5 * float(min(upper[0] - lower[0], upper[2] - lower[2]))
    head = radius * rng.uniform(0.6, 0.75)
    body = radius * rng.uniform(1.0, 1.15)
    middle = tall * rng.uniform(0.35, 0.45)
    parts: tuple[Primitive, ...] = (
        Turned((x, z), ((floor, 0.85 * body), (floor + middle, 0.8 * body))),
        Ellipsoid((x, floor + middle, z), (body, 0.45 * tall, body)),
        Ellipsoid((x, floor + middle + 0.4 * tall + 0.6 * head, z), (head, head, head)),
    )
    # The ellipsoid's lower end is cut off by the floor.
    below = Block((x - 1.0, floor - 1.0, z - 1.0), (x + 1.0, floor, z + 1.0))
    clipped = Cut(parts, (below,))
    return Solid(parts=(clipped,), origin=(x, floor, z))


_FLAT: Mapping[str, Maker] = MappingProxyType({f"flat {name}": _flat(name) for name in FIGURES})
_STANDING: Mapping[str, Maker] = MappingProxyType(
    {
        "stairs": _standing_figure(_stairs),
        "seat": _standing_figure(_seat),
        "trough": _standing_figure(_trough),
        "house": _standing_figure(_upright_house),
        "tower": _standing_figure(_tower_block),
        "ramp": _standing_figure(_ramp),
        "vase": _turned,
        "bottle": _bottle,
        "bowl": _bowl,
        "figurine": _figurine,
    }
)
