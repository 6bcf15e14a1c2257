"""The solids that tasks ask for: airplane, chair, bottle and star.

Each stands where its start body comes to rest, and reaches at most about 0.1 beyond it. Their volumes are near those of the
start bodies already; `Solid.positions` makes them equal.
"""

from __future__ import annotations

import numpy as np

from cpdeform.tasks.solids import Block, Ellipsoid, Prism, Solid, Turned


def _mirrored(outline: tuple[tuple[float, float], ...]) -> tuple[tuple[float, float], ...]:
    """An outline of pairs of x and z, mirrored at x = 0.5."""
    return tuple((1.0 - x, z) for x, z in outline)


def airplane() -> Solid:
    """An airplane with its nose towards +z: a slab's sides, squeezed in before and behind the wings."""
    floor = 0.31
    wing = ((0.53, 0.590), (0.66, 0.540), (0.66, 0.465), (0.53, 0.450))
    tail = ((0.53, 0.385), (0.60, 0.360), (0.60, 0.315), (0.53, 0.315))
    return Solid(
        parts=(
            Block((0.455, floor, 0.325), (0.545, floor + 0.088, 0.625)),
            Ellipsoid((0.5, floor + 0.044, 0.625), (0.045, 0.044, 0.07)),
            Prism(wing, floor, floor + 0.072),
            Prism(_mirrored(wing), floor, floor + 0.072),
            Prism(tail, floor, floor + 0.072),
            Prism(_mirrored(tail), floor, floor + 0.072),
            Block((0.482, floor, 0.32), (0.518, floor + 0.135, 0.375)),
        ),
        origin=(0.5, floor, 0.5),
        scaled_axes=(0, 2),
    )


def chair() -> Solid:
    """An armchair that is open towards +z: the block's upper front, pressed down between the arms."""
    floor = 0.3125
    x_low, x_high, z_low, z_high = 0.375, 0.625, 0.388, 0.612
    seat, arm, top = floor + 0.135, floor + 0.205, floor + 0.30
    return Solid(
        parts=(
            Block((x_low, floor, z_low), (x_high, seat, z_high)),
            Block((x_low, floor, z_low), (x_high, top, z_low + 0.075)),
            Block((x_low, floor, z_low), (x_low + 0.058, arm, z_high)),
            Block((x_high - 0.058, floor, z_low), (x_high, arm, z_high)),
        ),
        origin=(0.5, floor, 0.5),
    )


def bottle() -> Solid:
    """A bottle: the block's upper part, squeezed into a neck, the lower part as wide as before but round."""
    floor = 0.3005
    profile = ((0.0, 0.080), (0.008, 0.085), (0.245, 0.085), (0.290, 0.048), (0.440, 0.044), (0.441, 0.050), (0.47, 0.050))
    return Solid(
        parts=(Turned((0.5, 0.5), tuple((floor + height, radius) for height, radius in profile)),), origin=(0.5, floor, 0.5)
    )


def star() -> Solid:
    """A flat star with five blunt tips, one of them towards -z."""
    floor, thickness = 0.3155, 0.0665
    tip, notch, half_tip = 0.225, 0.118, 0.012
    outline: list[tuple[float, float]] = []
    for number in range(5):
        angle = 2.0 * np.pi * number / 5.0
        outward = np.array([np.sin(angle), -np.cos(angle)])
        aside = np.array([np.cos(angle), np.sin(angle)])
        between = angle + np.pi / 5.0
        inward_corner = notch * np.array([np.sin(between), -np.cos(between)])
        corners = (tip * outward - half_tip * aside, tip * outward + half_tip * aside, inward_corner)
        outline += [(0.5 + float(x), 0.5 + float(z)) for x, z in corners]
    return Solid(parts=(Prism(tuple(outline), floor, floor + thickness),), origin=(0.5, floor, 0.5), scaled_axes=(0, 2))
