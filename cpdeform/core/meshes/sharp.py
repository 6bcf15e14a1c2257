"""Cells of a distance grid that its spline rounds off: at sharp edges and where the nearest place on the surface jumps.

There kernels compute the distance to the triangles that are nearest. Everywhere else the spline is better than they are: between
the facets of a surface that is meant to be smooth its normal turns evenly.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from cpdeform.core.meshes.mesh import Array, Mesh, geometry_library
from cpdeform.core.meshes.triangles import TRIANGLE_SIZE, Indices, neighbours, signed_distance, triangle_numbers

SHARP = 0.1
"""Difference from 1 of the length of the spline's gradient that a sharp edge makes. It is about a quarter of the angle (radians) by
which the normal jumps; facets of a round surface that differ by less than 20 degrees make less."""

ROUNDED = 0.02
"""Such a difference that counts within `BESIDE` cells of a sharp edge."""

BESIDE = 2

MOST_NEAREST = 24
"""Triangles that a cell may have; where more meet, as inside a finely divided ball, the spline stays."""

DISTANCE_ERROR = 0.01
"""Largest error of a cell's triangles against the mesh, in distances between nodes; where parts overlap, the spline stays."""

EDGE = 4
"""Cells at the grid's faces that are left out: the spline is off there, too, but no tool is felt so far away."""

CHUNK = 2**11
"""Cells looked at together."""


@dataclasses.dataclass(frozen=True, eq=False)
class SharpCells:
    """Cells (a cell is the cube around a node) and the triangles that are nearest somewhere in them.

    Attributes:
        cell: The node (K,) in the middle of each cell, its index in the grid in C order.
        group: Which group (K,) of triangles is nearest in it.
        start: Where each group's triangles begin in `triangle`, (G + 1,) with the end of the last.
        triangle: Triangles (T,) of the mesh, one group after the other.
    """

    cell: Indices
    group: Indices
    start: Indices
    triangle: Indices

    @classmethod
    def none(cls) -> SharpCells:
        """No cells: the spline serves everywhere."""
        empty = np.zeros(0, dtype=np.int64)
        return cls(empty, empty, np.zeros(1, dtype=np.int64), empty)

    def fits(self, *, nodes: int, faces: int) -> bool:
        """Whether all indices are within a grid of this many nodes and a mesh of this many faces."""
        groups = len(self.start) - 1
        return bool(
            groups >= 0
            and _within(self.cell, nodes)
            and _within(self.group, groups)
            and _within(self.triangle, faces)
            and self.start[0] == 0
            and self.start[-1] == len(self.triangle)
            and np.all((np.diff(self.start) >= 1) & (np.diff(self.start) <= MOST_NEAREST))
        )

    def kernel_numbers(self, mesh: Mesh, *, nodes: int) -> Array:
        """What kernels read after the spline's coefficients (nodes + L,).

        First a number for each node: 0, or where the cell's group is, counted from the end of these numbers. A group is the number
        of its triangles and where the numbers of each are; 0 is there once more, so that no group is at 0.
        """
        used, local = np.unique(self.triangle, return_inverse=True)
        sizes = np.diff(self.start)
        places = 1 + self.start[:-1] + np.arange(len(sizes))
        lists = np.zeros(1 + len(sizes) + len(self.triangle))
        lists[places] = sizes
        inside = np.ones(len(lists), dtype=bool)
        inside[0] = False
        inside[places] = False
        lists[inside] = len(lists) + TRIANGLE_SIZE * local.reshape(-1)
        table = np.zeros(nodes)
        table[self.cell] = places[self.group]
        return np.concatenate([table, lists, triangle_numbers(mesh, used).reshape(-1)])


def find_sharp_cells(mesh: Mesh, coefficients: Array, spacing: float) -> SharpCells:
    """The cells of a grid that need triangles.

    Args:
        mesh: A closed mesh around the origin.
        coefficients: Coefficients (X, Y, Z) of the spline through its signed distances; the grid's middle is the origin.
        spacing: Distance between nodes.
    """
    from scipy.ndimage import maximum_filter

    rounded = _rounded(coefficients, spacing)
    cells = np.flatnonzero(rounded)
    if not len(cells):
        return SharpCells.none()
    nearest = _Nearest(mesh, rounded, spacing)
    found = [nearest.of(cells[first : first + CHUNK]) for first in range(0, len(cells), CHUNK)]
    cell, triangles, exact = (np.concatenate(part) for part in zip(*found, strict=True))
    wrong = np.zeros(coefficients.size, dtype=bool)
    wrong[cell[~exact]] = True
    # Random places miss some of the cells that the surface of a part inside another one goes through, but not their neighbours.
    exact = ~maximum_filter(wrong.reshape(coefficients.shape), size=3).reshape(-1)[cell]
    if not exact.any():
        return SharpCells.none()
    kept = cell[exact]
    groups, group = np.unique(triangles[exact], axis=0, return_inverse=True)
    there = groups >= 0
    start = np.concatenate([[0], np.cumsum(there.sum(axis=1))])
    return SharpCells(kept, group.reshape(-1), start, groups[there])


def _within(indices: Indices, count: int) -> bool:
    return not len(indices) or (int(indices.min()) >= 0 and int(indices.max()) < count)


def _rounded(coefficients: Array, spacing: float) -> NDArray[np.bool_]:
    """Whether the spline rounds off a sharp edge in the cell around each node: its gradient is not of length 1 there.

    It is looked at in the middles of cells, of their faces and edges, and at their corners.
    """
    from scipy.ndimage import correlate1d, maximum_filter

    value = {False: [0.125, 0.75, 0.125], True: [0.5, 0.5, 0.0]}
    slope = {False: [-0.5, 0.0, 0.5], True: [-1.0, 1.0, 0.0]}
    error = np.zeros(coefficients.shape)
    for between in np.ndindex(2, 2, 2):
        square = np.zeros(coefficients.shape)
        for along in range(3):
            part = coefficients
            for axis in range(3):
                weights = (slope if axis == along else value)[bool(between[axis])]
                part = correlate1d(part, weights, axis=axis, mode="nearest")
            square += np.square(part / spacing)
        here = np.abs(np.sqrt(square) - 1.0)
        # between two nodes: of both their cells
        for axis in range(3):
            if between[axis]:
                here = np.maximum(here, np.roll(here, -1, axis=axis))
        error = np.maximum(error, here)
    inner = np.zeros(coefficients.shape, dtype=bool)
    inner[EDGE:-EDGE, EDGE:-EDGE, EDGE:-EDGE] = True
    near = maximum_filter(inner & (error > SHARP), size=2 * BESIDE + 1)
    return np.asarray(inner & near & (error > ROUNDED))


class _Nearest:
    """Looks for the triangles that are nearest to places in cells."""

    def __init__(self, mesh: Mesh, rounded: NDArray[np.bool_], spacing: float) -> None:
        self.mesh, self.spacing, self.shape = mesh, spacing, rounded.shape
        self._numbers = triangle_numbers(mesh, np.arange(len(mesh.faces)))
        self._beside = neighbours(mesh)
        self._generator = np.random.default_rng(0)
        grid = np.array(rounded.shape)
        # Places lie on a lattice of half the distance, so that neighbouring cells share them.
        wanted = np.zeros(2 * grid + 1, dtype=bool)
        nodes = np.stack(np.nonzero(rounded), axis=1)
        self._offsets = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
        for offset in self._offsets:
            wanted[tuple((2 * nodes + 1 + offset).T)] = True
        places = np.stack(np.nonzero(wanted), axis=1)
        points = (0.5 * (places - 1) - 0.5 * (grid - 1)) * spacing
        face = geometry_library().point_mesh_squared_distance(points, mesh.vertices, mesh.faces)[1]
        self._face = np.full(wanted.shape, -1, dtype=np.int32)
        self._face[tuple(places.T)] = face

    def of(self, cells: Indices) -> tuple[Indices, Indices, NDArray[np.bool_]]:
        """Cells (K,) with few triangles, these (K, `MOST_NEAREST`), -1 for none, and whether they give the distance."""
        nodes = np.stack(np.unravel_index(cells, self.shape), axis=1)
        middles = (nodes - 0.5 * (np.array(self.shape) - 1)) * self.spacing
        at_places = np.stack([self._face[tuple((2 * nodes + 1 + offset).T)] for offset in self._offsets], axis=1).astype(np.int64)
        seen = _sets(at_places)
        around = np.where(seen[..., None] >= 0, self._beside[seen], -1).reshape(len(cells), -1)
        triangles = _sets(np.concatenate([seen, around], axis=1))
        away = np.where(triangles >= 0, np.abs(signed_distance(middles[:, None], self._numbers[triangles])), np.inf)
        # No place in the cell is farther from its middle than half the cell's diagonal.
        reach = away.min(axis=1, keepdims=True) + np.sqrt(3.0) * self.spacing
        triangles = np.where(away <= reach, triangles, -1)
        few = (triangles >= 0).sum(axis=1) <= MOST_NEAREST
        cells, middles, triangles = cells[few], middles[few], _sets(triangles[few])
        filled = np.full((len(cells), MOST_NEAREST), -1, dtype=np.int64)
        filled[:, : triangles.shape[1]] = triangles
        return cells, filled, self._exact(middles, triangles)

    def _exact(self, middles: Array, triangles: Indices, *, places: int = 4) -> NDArray[np.bool_]:
        """Whether the triangles (K, S) give the mesh's signed distance at random places of the cells around middles (K, 3)."""
        points = middles[:, None] + self._generator.uniform(-0.5, 0.5, (len(middles), places, 3)) * self.spacing
        found = signed_distance(points[:, :, None], self._numbers[triangles][:, None])
        size = np.where(triangles[:, None] >= 0, np.abs(found), np.inf)
        nearest = np.take_along_axis(found, size.argmin(axis=-1)[..., None], axis=-1)[..., 0]
        expected = self.mesh.signed_distance(points.reshape(-1, 3)).reshape(nearest.shape) if len(middles) else nearest
        return np.asarray(np.abs(nearest - expected).max(axis=1, initial=0.0) < DISTANCE_ERROR * self.spacing)


def _sets(indices: Indices) -> Indices:
    """The different indices (not -1) in each row (K, S), sorted downwards, -1 after them: (K, most in a row)."""
    ordered = -np.sort(-indices, axis=1)
    ordered[:, 1:][ordered[:, 1:] == ordered[:, :-1]] = -1
    ordered = -np.sort(-ordered, axis=1)
    return np.asarray(ordered[:, : max(1, int((ordered >= 0).sum(axis=1).max(initial=1)))])
