"""Mesh files: read, repaired where that is safe, and refused with reasons where it is not."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cpdeform.core.errors import InputError, MissingExtraError
from cpdeform.core.meshes.mesh import Array, Axis, Mesh
from cpdeform.core.reading.boundary import boundary
from cpdeform.core.reading.limits import ReadingLimits, default_limits

UP: dict[str, Axis] = {".stl": "z", ".ply": "z", ".obj": "y", ".glb": "y"}
"""File formats, and the axis that points upwards in most files of each."""

EXPECTED = "a mesh in an .stl, .obj, .ply or .glb file"
MOST_TRIANGLES = 2_000_000
MOST_HOLE_AREA = 0.02
"""Share of the whole surface that holes may be, to be closed: they are cracks then, and not the open side of a shape."""

LEAST_EXTENT = 1e-3
"""Smallest edge of a mesh's box, as a share of the largest; what is flatter is a sheet."""


def read_mesh(path: Path, *, up: Axis | None = None, limits: ReadingLimits | None = None) -> tuple[Mesh, list[str]]:
    """Read a mesh and repair it.

    Corners at the same place are joined, triangles without area and repeated ones removed, sides turned outwards and small holes
    closed. Parts may overlap: they are joined.

    Args:
        path: An STL, OBJ, PLY or GLB file. Nothing but this file is read: no materials, no textures.
        up: The axis that points upwards in it; defaults to z for STL and PLY, y for OBJ and GLB.
        limits: How large it may be; defaults to `cpdeform.core.reading.limits.default_limits`.

    Returns:
        The mesh in the file's own units, y up, and what was repaired, one sentence each.

    Raises:
        InputError: The file cannot be read, holds no triangles, or its surface is open, flat or inside out beyond repair.
        MissingExtraError: The extra `meshes` is not installed.
    """
    argument = f"mesh {path}"
    suffix = path.suffix.lower()
    if suffix not in UP:
        raise InputError(argument, came=f'a file name that ends in "{path.suffix}"', expected=EXPECTED)
    limits = limits or default_limits()
    with boundary(argument, expected=EXPECTED):
        size = path.stat().st_size
        if size > limits.array_bytes:
            raise InputError(argument, came=f"{size / 2**20:.0f} MiB", expected=f"at most {limits.array_bytes / 2**20:.0f} MiB")
        loaded = _load(path.read_bytes(), suffix[1:])
    vertices, faces = np.asarray(loaded.vertices, dtype=np.float64), np.asarray(loaded.faces, dtype=np.int64)
    if not len(faces):
        raise InputError(argument, came="no triangles", expected="a surface of triangles", remedy="Export it as a mesh.")
    if len(faces) > MOST_TRIANGLES:
        raise InputError(
            argument, came=f"{len(faces)} triangles", expected=f"at most {MOST_TRIANGLES}", remedy="Simplify the mesh."
        )
    if not np.isfinite(vertices).all():
        raise InputError(argument, came="corners with nan or infinity", expected="finite corners")
    mesh, notes = repaired(loaded, argument=argument)
    return mesh.turned(up or UP[suffix]), notes


def repaired(loaded: Any, *, argument: str) -> tuple[Mesh, list[str]]:
    """A closed mesh of a `trimesh.Trimesh`, and what was done to it.

    Raises:
        InputError: It cannot be closed, or is flat.
    """
    import trimesh

    notes, before = [], len(loaded.faces)
    loaded.merge_vertices()
    loaded.update_faces(loaded.nondegenerate_faces() & loaded.unique_faces())
    loaded.remove_unreferenced_vertices()
    if len(loaded.faces) < before:
        notes.append(f"{before - len(loaded.faces)} triangles without area or there twice were removed.")
    extents = np.ptp(loaded.vertices, axis=0) if len(loaded.faces) else np.zeros(3)
    if not extents.min() > LEAST_EXTENT * extents.max():
        raise InputError(argument, came=f"a flat sheet of {_size(extents)}", expected="a solid", remedy="Give it thickness.")
    if not loaded.is_winding_consistent:
        trimesh.repair.fix_winding(loaded)
        notes.append("Triangles were turned so that all of them face the same side.")
    mesh = Mesh(np.array(loaded.vertices), np.array(loaded.faces, dtype=np.int64))
    mesh, holes = _closed(mesh, argument=argument)
    if holes:
        notes.append(f"{holes} small hole{'' if holes == 1 else 's'} {'was' if holes == 1 else 'were'} closed.")
    if _enclosed(mesh) < 0.0:
        mesh = Mesh(mesh.vertices, mesh.faces[:, ::-1].copy())
        notes.append("It was inside out, and has been turned.")
    return mesh, notes


def _load(content: bytes, kind: str) -> Any:
    try:
        import trimesh
    except ImportError as error:
        raise MissingExtraError("shape", "Mesh", module="trimesh", install='pip install "cpdeform[meshes]"') from error
    # From memory and without a resolver: a file that names others does not make us read them.
    return trimesh.load_mesh(io.BytesIO(content), file_type=kind, resolver=None, process=False, skip_materials=True)


def _closed(mesh: Mesh, *, argument: str) -> tuple[Mesh, int]:
    """The mesh with its holes closed by fans of triangles, and how many there were."""
    loops = _boundary_loops(mesh.faces)
    if not loops:
        return mesh, 0
    area = float(np.linalg.norm(_area_vectors(mesh), axis=1).sum())
    fans, vertices = [], [mesh.vertices]
    hole_area, count = 0.0, len(mesh.vertices)
    for loop in loops:
        centre = mesh.vertices[loop].mean(axis=0)
        following = np.roll(loop, -1)
        # The boundary runs against its triangles.
        fans.append(np.stack([following, loop, np.full(len(loop), count)], axis=1))
        sides = np.cross(mesh.vertices[loop] - centre, mesh.vertices[following] - centre)
        hole_area += 0.5 * float(np.linalg.norm(sides, axis=1).sum())
        vertices.append(centre[None])
        count += 1
    if hole_area > MOST_HOLE_AREA * area:
        raise InputError(
            argument,
            came=f"an open surface: {len(loops)} hole{'' if len(loops) == 1 else 's'}, {hole_area / (area + hole_area):.0%} of it",
            expected=f"a closed one, or holes of at most {MOST_HOLE_AREA:.0%}",
            remedy="Close it in a modelling program (in Blender: Solidify gives a sheet thickness, Fill closes an edge).",
        )
    return Mesh(np.concatenate(vertices), np.concatenate([mesh.faces, *fans])), len(loops)


def _boundary_loops(faces: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    """Closed chains of vertices along edges that one triangle alone has, each in the direction of its triangles."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    keys = np.sort(edges, axis=1)
    _, where, counts = np.unique(keys, axis=0, return_inverse=True, return_counts=True)
    following = {int(first): int(second) for first, second in edges[counts[where.reshape(-1)] == 1]}
    loops = []
    while following:
        start, _ = next(iter(following.items()))
        loop, vertex = [], start
        while vertex in following:
            loop.append(vertex)
            vertex = following.pop(vertex)
        if vertex == start and len(loop) > 2:
            loops.append(np.array(loop))
    return loops


def _area_vectors(mesh: Mesh) -> Array:
    """Half the cross product (F, 3) of each triangle's edges."""
    first, second, third = (mesh.vertices[mesh.faces[:, corner]] for corner in range(3))
    return np.asarray(0.5 * np.cross(second - first, third - first))


def _enclosed(mesh: Mesh) -> float:
    """Signed volume; negative where triangles face inwards."""
    middle = mesh.vertices[mesh.faces].mean(axis=1) - mesh.vertices.mean(axis=0)
    return float((middle * _area_vectors(mesh)).sum() / 3.0)


def _size(extents: Array) -> str:
    return " x ".join(f"{edge:.3g}" for edge in extents)
