"""Distances to triangles, and the cells of a grid that have some: where its spline would round off what is sharp."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cpdeform.core.meshes.grid import DistanceGrid, make_grid, read_shape, write_shape
from cpdeform.core.meshes.mesh import Mesh
from cpdeform.core.meshes.triangles import TRIANGLE_SIZE, neighbours, signed_distance, triangle_numbers

trimesh = pytest.importorskip("trimesh")
igl = pytest.importorskip("igl")

WIDTHS = (0.1, 0.08, 0.12)


def mesh_of(loaded) -> Mesh:
    return Mesh(np.array(loaded.vertices), np.array(loaded.faces, dtype=np.int64))


def angle_bar() -> Mesh:
    """A bar with the section of an L: one of its edges goes in. All triangles of an end have the corner that goes in."""
    outline = np.array([[0.03, 0.03], [0.0, 0.09], [0.0, 0.0], [0.09, 0.0], [0.09, 0.03]])
    outline = np.insert(outline, 1, [0.03, 0.09], axis=0)
    count = len(outline)
    vertices = np.concatenate([np.insert(outline, 2, height, axis=1) for height in (0.0, 0.05)])
    fan = np.array([[0, i, i + 1] for i in range(1, count - 1)])
    sides = [[[i, j, j + count], [i, j + count, i + count]] for i, j in ((i, (i + 1) % count) for i in range(count))]
    return Mesh(vertices, np.concatenate([fan[:, ::-1], fan + count, np.array(sides).reshape(-1, 3)])).centred()


def read_cell(grid: DistanceGrid, cell: int) -> np.ndarray:
    """The triangles (K, 30) of a cell, read as kernels do it."""
    nodes = grid.distance.size
    numbers, lists = grid.kernel_numbers, grid.kernel_numbers[2 * nodes :]
    place = int(numbers[nodes + cell])
    if place == 0:
        return np.zeros((0, TRIANGLE_SIZE))
    return np.stack([lists[int(at) : int(at) + TRIANGLE_SIZE] for at in lists[place + 1 : place + 1 + int(lists[place])]])


def test_the_nearest_triangle_gives_the_signed_distance() -> None:
    mesh = mesh_of(trimesh.creation.annulus(0.03, 0.05, 0.04))
    points = np.random.default_rng(0).uniform(-0.07, 0.07, (2000, 3))
    found = signed_distance(points[:, None], triangle_numbers(mesh, np.arange(len(mesh.faces))))
    nearest = np.take_along_axis(found, np.abs(found).argmin(axis=1)[:, None], axis=1)[:, 0]
    expected = igl.signed_distance(points, mesh.vertices, mesh.faces, sign_type=igl.SIGNED_DISTANCE_TYPE_PSEUDONORMAL)[0]
    np.testing.assert_allclose(nearest, expected, atol=1e-12)
    np.testing.assert_allclose(mesh.signed_distance(points), expected, atol=1e-12)


def test_neighbours_share_an_edge() -> None:
    mesh = mesh_of(trimesh.creation.box(WIDTHS))
    for face, others in zip(mesh.faces, mesh.faces[neighbours(mesh)], strict=True):
        assert [len(set(face) & set(other)) for other in others] == [2, 2, 2]


def test_cells_at_sharp_edges_know_the_exact_distance(tmp_path: Path) -> None:
    write_shape(tmp_path / "block.npz", make_grid(mesh_of(trimesh.creation.box(WIDTHS)), resolution=24))
    grid = read_shape(tmp_path / "block.npz").scaled(2.0)
    half = np.array(WIDTHS)  # of the scaled block
    generator = np.random.default_rng(1)
    shape = np.array(grid.distance.shape)
    for cell in generator.choice(grid.sharp.cell, 200):
        middle = (np.array(np.unravel_index(cell, shape)) - 0.5 * (shape - 1)) * grid.spacing
        point = middle + generator.uniform(-0.5, 0.5, 3) * grid.spacing
        beyond = np.abs(point) - half
        expected = np.linalg.norm(np.maximum(beyond, 0.0)) + min(beyond.max(), 0.0)
        found = signed_distance(point, read_cell(grid, int(cell)))
        assert found[np.abs(found).argmin()] == pytest.approx(expected, abs=1e-7)
    # Every edge runs through such cells.
    edge = np.stack([np.full(50, half[0]), np.full(50, half[1]), np.linspace(-half[2], half[2], 50)], axis=1)
    nodes = np.rint(edge / grid.spacing + 0.5 * (shape - 1)).astype(int)
    assert np.isin(np.ravel_multi_index(tuple(nodes.T), grid.distance.shape), grid.sharp.cell).all()


@pytest.mark.parametrize("name", ["ball", "bar", "overlapping"])
def test_triangles_are_for_sharp_edges_only(name: str) -> None:
    if name == "ball":
        mesh = mesh_of(trimesh.creation.icosphere(subdivisions=3, radius=0.05))
    elif name == "bar":
        mesh = angle_bar()
    else:
        parts = [trimesh.creation.box((0.1, 0.06, 0.06)), trimesh.creation.box((0.06, 0.1, 0.06))]
        mesh = mesh_of(trimesh.util.concatenate(parts))
    grid = make_grid(mesh, resolution=24)
    near = np.abs(grid.distance.reshape(-1)) < 2.0 * grid.spacing
    share = np.isin(np.flatnonzero(near), grid.sharp.cell).mean()
    if name == "ball":
        assert share == 0.0
        return
    assert share > 0.1
    generator = np.random.default_rng(2)
    shape = np.array(grid.distance.shape)
    cells = generator.choice(grid.sharp.cell, 200)
    middles = (np.stack(np.unravel_index(cells, shape), axis=1) - 0.5 * (shape - 1)) * grid.spacing
    points = middles + generator.uniform(-0.5, 0.5, (200, 3)) * grid.spacing
    expected = grid.mesh.signed_distance(points)
    for cell, point, distance in zip(cells, points, expected, strict=True):
        found = signed_distance(point, read_cell(grid, int(cell)))
        # Where parts overlap their inner surfaces have another sign, and the spline stays.
        assert found[np.abs(found).argmin()] == pytest.approx(distance, abs=0.1 * grid.spacing)


def test_files_without_sharp_cells_are_read_as_before(tmp_path: Path) -> None:
    grid = make_grid(mesh_of(trimesh.creation.box(WIDTHS)), resolution=16)
    write_shape(tmp_path / "new.npz", grid)
    with np.load(tmp_path / "new.npz") as file:
        np.savez(tmp_path / "old.npz", **{name: file[name] for name in file if not name.startswith("sharp")})
    old = read_shape(tmp_path / "old.npz")
    assert len(old.sharp.cell) == 0
    np.testing.assert_array_equal(
        old.kernel_numbers[: old.distance.size], read_shape(tmp_path / "new.npz").coefficients.reshape(-1)
    )
    assert not old.kernel_numbers[old.distance.size :].any()
