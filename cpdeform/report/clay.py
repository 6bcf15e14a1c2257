"""Clay for the renderer: points all over its surface, with their normals and colours, and the crumbs beside it."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from cpdeform.report.surface import Mesh, clay_surface, particle_spacing

Array = NDArray[np.float64]

NEIGHBOURS = 4
"""Particles whose colours a place on the surface mixes."""


@dataclasses.dataclass(frozen=True)
class ClayPoints:
    """Points that cover the surface of clay.

    Attributes:
        positions: Points (P, 3), length units.
        normals: Unit normals (P, 3); zero for crumbs, which are round.
        colours: Colours (P, 3), in [0, 1].
        crumbs: Positions (L, 3) of particles that no surface shows.
        crumb_colours: Their colours (L, 3).
        crumb_radius: Radius that they are drawn with, length units.
    """

    positions: Array
    normals: Array
    colours: Array
    crumbs: Array
    crumb_colours: Array
    crumb_radius: float


def clay_points(particles: Array, colours: Array, *, distance: float, spacing: float | None = None) -> ClayPoints:
    """Cover the surface of clay with points.

    Args:
        particles: Positions (N, 3), length units.
        colours: Colours (N, 3) of the particles, in [0, 1].
        distance: How far apart the points may lie, length units.
        spacing: Edge of the cube that a particle has to itself, length units; defaults to `particle_spacing`.
    """
    from scipy.spatial import cKDTree

    spacing = spacing or particle_spacing(particles)
    mesh = clay_surface(particles, spacing=spacing)
    positions, normals = sample_mesh(mesh, distance)
    if len(positions):
        count = min(NEIGHBOURS, len(particles))
        # Colours vary over particles, not over pixels: those at the corners are mixed like the corners themselves.
        near = np.atleast_2d(cKDTree(np.nan_to_num(particles)).query(mesh.vertices, k=count)[1].reshape(-1, count))
        at_corners = Mesh(colours[near].mean(axis=1), mesh.normals, mesh.triangles, mesh.loose)
        mixed = sample_mesh(at_corners, distance, like=mesh)[0]
    else:
        mixed = positions
    return ClayPoints(positions, normals, mixed, particles[mesh.loose], colours[mesh.loose], 0.6 * spacing)


def sample_mesh(mesh: Mesh, distance: float, *, like: Mesh | None = None) -> tuple[Array, Array]:
    """Points all over a mesh (P, 3) and their normals (P, 3), the same number on each triangle, in rows along its edges.

    Args:
        mesh: The mesh.
        distance: How far apart the points may lie.
        like: A mesh of the same triangles whose edges say how many points there are; defaults to the mesh itself.
    """
    if not len(mesh.triangles):
        return np.zeros((0, 3)), np.zeros((0, 3))
    measured = (like or mesh).vertices[mesh.triangles]
    longest = float(np.linalg.norm(measured - np.roll(measured, 1, axis=1), axis=2).max())
    steps = int(np.clip(np.ceil(longest / distance), 1, 64))
    first, second = np.meshgrid(np.arange(steps + 1), np.arange(steps + 1), indexing="ij")
    inside = first + second <= steps
    weights = np.stack([first[inside], second[inside], steps - (first + second)[inside]], axis=1) / steps
    points, normals = (
        np.einsum("kc,fcx->fkx", weights, values[mesh.triangles]).reshape(-1, 3) for values in (mesh.vertices, mesh.normals)
    )
    return points, normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
