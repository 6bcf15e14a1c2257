"""Volume and parts of a cloud of particles, by the space that it occupies."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FILLED = 2.5
"""Gaps between particles are filled up to this many times the typical distance of neighbours, to both sides."""
VOXELS = 4
"""Voxels along that distance."""
MOST_VOXELS = 8e6
"""About as many voxels are looked at, at the most; at 25 bytes each."""
NEIGHBOURS = 8


def filling_radius(*clouds: NDArray[np.float64]) -> float:
    """A radius of `filled_volume` that leaves no holes inside any of the clouds (N, 3) of at least two particles, length units."""
    from scipy.spatial import KDTree

    spacings, boxes = [], []
    for positions in clouds:
        boxes.append(float(np.prod(np.ptp(positions, axis=0))))
        some = positions[:: max(1, len(positions) // 2000)]
        distances = KDTree(positions).query(some, k=min(NEIGHBOURS, len(positions) - 1) + 1)[0][:, -1]
        # the volume of a ball of NEIGHBOURS particles, as a cube for each
        spacings.append(float(np.percentile(distances, 75)) * (4.0 / 3.0 * np.pi / NEIGHBOURS) ** (1.0 / 3.0))
    return float(max(FILLED * max(spacings), VOXELS * (max(boxes) / MOST_VOXELS) ** (1.0 / 3.0)))


def filled_volume(positions: NDArray[np.float64], radius: float) -> float:
    """Volume that particles (N, 3) occupy, length units: that of their morphological closing with a ball.

    All that is within `radius` of a particle, less what is within `radius` of the outside: gaps between particles are filled, the
    outer surface stays where the particles end, whatever their density.
    """
    from scipy.ndimage import distance_transform_edt

    edge = radius / VOXELS
    cells = np.floor(positions / edge).astype(np.int64)
    margin = VOXELS + 2
    cells -= cells.min(axis=0) - margin
    empty = np.ones(tuple(cells.max(axis=0) + margin + 1), dtype=bool)
    empty[tuple(cells.T)] = False
    near = distance_transform_edt(empty) <= VOXELS
    inside = distance_transform_edt(near) > VOXELS
    return float(inside.sum()) * edge**3


def solids(positions: NDArray[np.float64], distance: float) -> NDArray[np.int32]:
    """Number (N,) of the part that each particle belongs to: parts are farther from each other than `distance`, length units."""
    from scipy.ndimage import label

    cells = np.floor(positions / distance).astype(np.int64)
    cells -= cells.min(axis=0)
    grid = np.zeros(tuple(cells.max(axis=0) + 1), dtype=bool)
    grid[tuple(cells.T)] = True
    labels, _ = label(grid, structure=np.ones((3, 3, 3)))
    return np.asarray(labels[tuple(cells.T)] - 1, dtype=np.int32)
