"""Particles that fill a solid evenly."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

POINTS_PER_PARTICLE = 24
"""Points of the solid that stand for the surroundings of one particle while the particles are relaxed."""

RELAXATIONS = 6
"""Rounds of Lloyd's relaxation; the nearest neighbours' distances hardly change after these."""


class Fillable(Protocol):
    """A solid that particles can fill."""

    @property
    def corners(self) -> tuple[Array, Array]:
        """Lower and upper corner (3,) of a box around the solid, length units."""

    def contains(self, points: Array) -> NDArray[np.bool_]:
        """Whether each of the points (K, 3), length units, is inside: (K,)."""


def even_points(count: int, *, skip: int = 0) -> Array:
    """Points (count, 3) that fill the unit cube evenly: multiples of powers of the root of x^4 = x + 1, modulo 1."""
    ratio = 1.2207440846057596
    number = np.arange(skip + 1, skip + count + 1, dtype=np.float64)[:, None]
    return np.asarray((0.5 + number * ratio ** -np.arange(1.0, 4.0)) % 1.0)


def fill_evenly(solid: Fillable, count: int) -> Array:
    """Fill a solid with particles that are about as far from their neighbours everywhere.

    Args:
        solid: What to fill.
        count: Number of particles N.

    Returns:
        Positions (N, 3), length units: an even sequence, relaxed by moving each particle to the centre of what is nearest to it.
    """
    from scipy.spatial import cKDTree

    cloud = _points_inside(solid, count * POINTS_PER_PARTICLE)
    # Every stretch of the sequence is even, so its beginning is a good start.
    particles = cloud[:count].copy()
    for _ in range(RELAXATIONS):
        _, nearest = cKDTree(particles).query(cloud)
        shares = np.bincount(nearest, minlength=count)
        for axis in range(3):
            centre = np.bincount(nearest, weights=cloud[:, axis], minlength=count) / np.maximum(shares, 1)
            particles[:, axis] = np.where(shares > 0, centre, particles[:, axis])
    return particles


def _points_inside(solid: Fillable, count: int) -> Array:
    """The first points (count, 3) of an even sequence that lie inside a solid, length units."""
    lower, upper = solid.corners
    share = max(float(solid.contains(lower + even_points(4096) * (upper - lower)).mean()), 1e-3)
    tried = int(1.05 * count / share) + 100
    points = lower + even_points(tried) * (upper - lower)
    inside = points[solid.contains(points)]
    while len(inside) < count:
        more = lower + even_points(tried, skip=len(points)) * (upper - lower)
        points = np.concatenate([points, more])
        inside = np.concatenate([inside, more[solid.contains(more)]])
    return inside[:count]
