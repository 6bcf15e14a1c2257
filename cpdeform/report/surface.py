"""The surface of clay: the level set of its density, as a triangle mesh."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

LEVEL = 0.5
"""Share of the density inside of a body at which its surface is drawn."""

LOOSE = 0.1
"""Share of it below which a particle is a crumb, which no surface shows."""

MARGIN = 3
"""Empty nodes around the particles."""


@dataclasses.dataclass(frozen=True)
class Mesh:
    """A closed triangle mesh.

    Attributes:
        vertices: Corners (V, 3), length units.
        normals: Unit normals (V, 3) at the corners, outwards.
        triangles: Indices (F, 3) of the corners, counter-clockwise seen from outside.
        loose: Indices (L,) of the particles that are crumbs outside of it.
    """

    vertices: Array
    normals: Array
    triangles: NDArray[np.int64]
    loose: NDArray[np.int64]


def particle_spacing(positions: Array) -> float:
    """Edge of the cube that a particle of a cloud (N, 3) has to itself, length units.

    Estimated from the distances to the eight nearest neighbours, so that it does not matter how the cloud is shaped.
    """
    from scipy.spatial import cKDTree

    count = min(9, len(positions))
    if count < 2:
        return 0.01
    distance = np.atleast_2d(cKDTree(positions).query(positions, k=count)[0])[:, -1]
    # A ball of that radius around a particle holds `count` of them.
    return float(np.clip(np.median(distance) * (4.0 / 3.0 * np.pi / count) ** (1.0 / 3.0), 1e-4, 0.1))


def clay_surface(positions: Array, *, spacing: float | None = None, smoothing: float = 1.35) -> Mesh:
    """Surface of a cloud of particles, by marching cubes [1]_ of their density.

    Args:
        positions: Particles (N, 3), length units.
        spacing: Edge of the cube that a particle has to itself, length units; defaults to `particle_spacing`. Give it where several
            clouds of a run should look alike.
        smoothing: Standard deviation of the Gaussian that makes particles a density, in units of `spacing`.

    Returns:
        The mesh; empty where nothing of the cloud is dense enough for a surface.

    References:
        .. [1] Lewiner, Lopes, Vieira, Tavares, "Efficient implementation of marching cubes' cases with topological guarantees",
           Journal of Graphics Tools, 2003.
    """
    from scipy.ndimage import gaussian_filter, map_coordinates
    from skimage.measure import marching_cubes

    known = np.flatnonzero(np.isfinite(positions).all(axis=1))
    points = positions[known]
    if not len(points):
        return Mesh(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64), known)
    spacing = spacing or particle_spacing(points)
    origin = points.min(axis=0) - (MARGIN + 3.0 * smoothing) * spacing
    shape = np.ceil((points.max(axis=0) - origin) / spacing + MARGIN + 3.0 * smoothing).astype(int) + 1
    places = (points - origin) / spacing
    density = gaussian_filter(deposit(places, shape), smoothing)
    loose = known[map_coordinates(density, places.T, order=1) < LOOSE]
    if density.max() <= LEVEL:
        return Mesh(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64), known)
    vertices, triangles, normals, _ = marching_cubes(density, LEVEL)
    return Mesh(vertices * spacing + origin, _unit(normals), triangles[:, ::-1].astype(np.int64), loose)


def deposit(places: Array, shape: Any) -> Array:
    """Spread particles at places (N, 3), in units of nodes, over the eight nodes around each; density (shape) of mass 1 each."""
    base = np.floor(places).astype(np.int64)
    share = places - base
    density = np.zeros(int(np.prod(shape)))
    for corner in np.ndindex(2, 2, 2):
        weight = np.prod(np.where(np.asarray(corner) == 1, share, 1.0 - share), axis=1)
        index = np.ravel_multi_index(tuple((base + corner).T), tuple(shape), mode="clip")
        density += np.bincount(index, weights=weight, minlength=len(density))
    return density.reshape(tuple(shape))


def _unit(vectors: Array) -> Array:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12), dtype=np.float64)
