"""A closed triangle mesh, and what is inside of it."""

from __future__ import annotations

import dataclasses
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from cpdeform.core.errors import MissingExtraError
from cpdeform.core.meshes.filling import even_points

Array = NDArray[np.float64]
Axis = Literal["x", "y", "z"]

VOLUME_POINTS = 2**17
"""Points that the volume is measured with; spread evenly, they give it to about 1e-3 of itself."""

INSIDE = 0.5
"""Winding number from which on a point counts as inside: parts that overlap are joined, and small cracks do not matter."""

TURNS = {
    "x": ((0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
    "y": ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
    "z": ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, -1.0, 0.0)),
}
"""Rotations (3, 3) that turn the file's upward axis to y."""


@dataclasses.dataclass(frozen=True)
class Mesh:
    """A closed surface of triangles. It is a `cpdeform.core.meshes.filling.Fillable`.

    Attributes:
        vertices: Corners (V, 3).
        faces: Indices (F, 3) of the corners of each triangle, counter-clockwise seen from outside.
    """

    vertices: Array
    faces: NDArray[np.int64]

    @property
    def corners(self) -> tuple[Array, Array]:
        """Lower and upper corner (3,) of a box around it."""
        return self.vertices.min(axis=0), self.vertices.max(axis=0)

    @property
    def extents(self) -> Array:
        """Edges (3,) of that box."""
        lower, upper = self.corners
        return np.asarray(upper - lower)

    def contains(self, points: Array) -> NDArray[np.bool_]:
        """Whether each of the points (K, 3) is inside: (K,)."""
        winding = geometry_library().fast_winding_number(self.vertices, self.faces, np.ascontiguousarray(points))
        return np.asarray(winding > INSIDE)

    def signed_distance(self, points: Array) -> Array:
        """Distance (K,) of points (K, 3) to the surface, negative inside."""
        points = np.ascontiguousarray(points)
        squared = geometry_library().point_mesh_squared_distance(points, self.vertices, self.faces)[0]
        # The library's own signed distance multiplies by an approximate winding number, which is up to 2% off, and not by its sign.
        return np.asarray(np.where(self.contains(points), -1.0, 1.0) * np.sqrt(squared))

    def volume(self) -> float:
        """Volume of what is inside, parts that overlap counted once."""
        lower, upper = self.corners
        points = lower + even_points(VOLUME_POINTS) * (upper - lower)
        return float(np.prod(upper - lower) * self.contains(points).mean())

    def turned(self, up: Axis) -> Mesh:
        """The mesh turned so that the axis `up` points along y."""
        return dataclasses.replace(self, vertices=self.vertices @ np.asarray(TURNS[up]).T)

    def scaled(self, factor: float) -> Mesh:
        """The mesh with all lengths multiplied."""
        return dataclasses.replace(self, vertices=factor * self.vertices)

    def centred(self) -> Mesh:
        """The mesh with the middle of its box at the origin."""
        lower, upper = self.corners
        return dataclasses.replace(self, vertices=self.vertices - 0.5 * (lower + upper))

    def standing_on(self, point: Array) -> Mesh:
        """The mesh moved so that the middle of its box's lower face is at a point (3,)."""
        lower, upper = self.corners
        foot = 0.5 * (lower + upper)
        foot[1] = lower[1]
        return dataclasses.replace(self, vertices=self.vertices + (np.asarray(point) - foot))


def geometry_library() -> Any:
    """The module `igl`, loaded where it is needed first.

    Raises:
        MissingExtraError: It is not installed.
    """
    try:
        import igl
    except ImportError as error:
        raise MissingExtraError("shape", "Mesh", module="igl", install='pip install "cpdeform[meshes]"') from error
    return igl
