"""Signed distances to triangles, and the numbers of a triangle that kernels compute them from."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cpdeform.core.meshes.mesh import Array, Mesh

Indices = NDArray[np.int64]

TRIANGLE_SIZE = 30
"""Numbers of a triangle: corners (3, 3), normal (3), mean normals at its edges (3, 3), the edge from each corner to the next, and
at its corners (3, 3)."""


def triangle_numbers(mesh: Mesh, faces: Indices) -> Array:
    """The numbers (K, `TRIANGLE_SIZE`) of some triangles of a closed mesh.

    The sign of a distance is that of the offset from the nearest place along the mean normal there: of the two triangles at an
    edge, of those around a corner weighted by their angles (Baerentzen and Aanaes, 2005).

    Args:
        mesh: The mesh.
        faces: Indices (K,) of the triangles.
    """
    corners = mesh.vertices[mesh.faces]
    edges = np.roll(corners, -1, axis=1) - corners
    normals = _unit(np.cross(edges[:, 0], edges[:, 1]))
    along = _unit(edges)
    angles = np.arccos(np.clip(-np.einsum("fcx,fcx->fc", along, np.roll(along, 1, axis=1)), -1.0, 1.0))
    at_corners = np.zeros_like(mesh.vertices)
    np.add.at(at_corners, mesh.faces, angles[..., None] * normals[:, None])
    ends = np.sort(np.stack([mesh.faces, np.roll(mesh.faces, -1, axis=1)], axis=-1), axis=-1).reshape(-1, 2)
    _, edge = np.unique(ends, axis=0, return_inverse=True)
    edge = edge.reshape(-1)
    at_edges = np.zeros((int(edge.max()) + 1, 3))
    np.add.at(at_edges, edge, np.repeat(normals, 3, axis=0))
    of_edges, of_corners = _unit(at_edges)[edge.reshape(-1, 3)], _unit(at_corners)[mesh.faces]
    parts = (corners[faces], normals[faces][:, None], of_edges[faces], of_corners[faces])
    return np.concatenate([part.reshape(len(faces), 3 * part.shape[1]) for part in parts], axis=1)


def neighbours(mesh: Mesh) -> Indices:
    """The triangle (F, 3) on the other side of each triangle's edges, itself where there is none."""
    ends = np.sort(np.stack([mesh.faces, np.roll(mesh.faces, -1, axis=1)], axis=-1), axis=-1).reshape(-1, 2)
    order = np.lexsort(ends.T)
    same = np.all(ends[order[1:]] == ends[order[:-1]], axis=1)
    result = np.repeat(np.arange(len(mesh.faces)), 3)
    first, second = order[:-1][same], order[1:][same]
    face = np.arange(len(ends)) // 3
    result[first], result[second] = face[second], face[first]
    return result.reshape(-1, 3)


def signed_distance(points: Array, triangles: Array) -> Array:
    """Signed distance (...) of points (..., 3) to triangles (..., `TRIANGLE_SIZE`), as kernels compute it: of each to its own.

    The sign means something at the nearest of a mesh's triangles only.
    """
    shape = np.broadcast_shapes(points.shape[:-1], triangles.shape[:-1])
    numbers = np.broadcast_to(triangles, (*shape, TRIANGLE_SIZE)).reshape(*shape, 10, 3)
    corners, normal, at_edges, at_corners = numbers[..., :3, :], numbers[..., 3, :], numbers[..., 4:7, :], numbers[..., 7:, :]
    offsets = points[..., None, :] - corners
    edges = np.roll(corners, -1, axis=-2) - corners
    inside = (np.cross(normal[..., None, :], edges) * offsets).sum(axis=-1).min(axis=-1) >= 0.0
    share = np.clip((offsets * edges).sum(axis=-1) / np.maximum((edges * edges).sum(axis=-1), 1e-300), 0.0, 1.0)
    ways = offsets - share[..., None] * edges
    lengths = np.linalg.norm(ways, axis=-1)
    nearest = lengths.argmin(axis=-1)[..., None]
    way, part = np.take_along_axis(ways, nearest[..., None], axis=-2)[..., 0, :], np.take_along_axis(share, nearest, axis=-1)
    edge = np.take_along_axis(at_edges, nearest[..., None], axis=-2)[..., 0, :]
    ends = [np.take_along_axis(at_corners, ((nearest + i) % 3)[..., None], axis=-2)[..., 0, :] for i in (0, 1)]
    mean = np.where(part <= 0.0, ends[0], np.where(part >= 1.0, ends[1], edge))
    length = np.take_along_axis(lengths, nearest, axis=-1)[..., 0]
    aside = np.where((way * mean).sum(axis=-1) < 0.0, -length, length)
    return np.asarray(np.where(inside, (normal * offsets[..., 0, :]).sum(axis=-1), aside))


def _unit(vectors: Array) -> Array:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-300))
