from __future__ import annotations

import json
import zlib

import numpy as np
import pytest
from scipy.spatial import cKDTree

from cpdeform.core.meshes.grid import make_grid, write_shape
from cpdeform.core.meshes.mesh import Mesh
from cpdeform.core.scene import ToolChopsticks, ToolMesh
from cpdeform.core.shapes.tool import shape_of
from cpdeform.report.page.encoding import QUANTA, decode_frames, encode_frames, encode_levels, spatial_order
from cpdeform.report.page.shapes import describe_tools, goal_distance
from cpdeform.report.shapes import tool_surface
from cpdeform.report.surface import clay_surface, particle_spacing


def moving_cloud(frames=6, count=400, seed=0):
    random = np.random.default_rng(seed)
    start, velocity = random.random((count, 3)), random.normal(0.0, 0.01, (count, 3))
    times = np.arange(frames)[:, None, None]
    return np.clip(start + times * velocity + random.normal(0.0, 1e-4, (frames, count, 3)), 0.0, 1.0)


@pytest.mark.parametrize("frames", [1, 2, 3, 7])
def test_positions_come_back_to_half_a_step(frames):
    positions = moving_cloud(frames)
    back = decode_frames(encode_frames(positions), particle_count=positions.shape[1])
    assert back.shape == positions.shape
    assert np.abs(back - positions).max() <= 0.5 / QUANTA + 1e-12


def test_corners_of_the_domain_and_wild_jumps_come_back():
    random = np.random.default_rng(1)
    positions = random.integers(0, 2, (9, 50, 3)).astype(float)
    np.testing.assert_array_equal(decode_frames(encode_frames(positions), particle_count=50), positions)


def test_even_motion_is_short():
    """A cloud that moves evenly takes little more than its first frame, and in order less than out of order."""
    positions = moving_cloud(20, 3000)
    start, still = positions[:1], np.repeat(positions[:1], 20, axis=0)
    assert len(encode_frames(still)) < 1.1 * len(encode_frames(start))
    assert len(encode_frames(start[:, spatial_order(start[0])])) < 0.9 * len(encode_frames(start))
    assert len(encode_frames(positions)) < 0.5 * positions.size * 2


def test_spatial_order_keeps_neighbours_together():
    cloud = np.random.default_rng(2).random((500, 3))
    order = spatial_order(cloud)
    assert sorted(order.tolist()) == list(range(500))

    def length(points):
        return np.linalg.norm(np.diff(points, axis=0), axis=1).sum()

    assert length(cloud[order]) < 0.5 * length(cloud)


def test_levels_span_the_finite_numbers():
    data, low, high = encode_levels(np.array([2.0, np.nan, 4.0, 3.0]))
    assert (low, high) == (2.0, 4.0)
    assert list(zlib.decompress(data)) == [0, 0, 255, 128]


def test_surface_of_a_ball_is_the_ball():
    random = np.random.default_rng(3)
    cloud = random.uniform(-1.0, 1.0, (60000, 3))
    cloud = 0.5 + 0.1 * cloud[np.linalg.norm(cloud, axis=1) < 1.0]
    spacing = (4.0 / 3.0 * np.pi * 0.1**3 / len(cloud)) ** (1.0 / 3.0)
    assert particle_spacing(cloud) == pytest.approx(spacing, rel=0.1)
    mesh = clay_surface(cloud)
    radius = np.linalg.norm(mesh.vertices - 0.5, axis=1)
    assert radius.mean() == pytest.approx(0.1, abs=0.5 * spacing)
    assert np.abs(radius - 0.1).max() < 2.0 * spacing
    a, b, c = (mesh.vertices[mesh.triangles[:, corner]] - 0.5 for corner in range(3))
    volume = np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6.0
    assert volume == pytest.approx(4.0 / 3.0 * np.pi * 0.1**3, rel=0.07)
    outwards = (mesh.vertices - 0.5) / np.linalg.norm(mesh.vertices - 0.5, axis=1, keepdims=True)
    assert np.einsum("ij,ij->i", mesh.normals, outwards).min() > 0.7


@pytest.mark.parametrize("count", [0, 1, 2])
def test_next_to_nothing_has_no_surface_and_is_loose(count):
    mesh = clay_surface(np.full((count, 3), 0.4) + np.arange(count)[:, None] * 0.1)
    assert mesh.vertices.shape == mesh.normals.shape == (0, 3)
    assert list(mesh.loose) == list(range(count))


def test_crumbs_are_loose_and_the_body_is_not():
    random = np.random.default_rng(5)
    body, crumbs = random.uniform(0.4, 0.6, (4000, 3)), np.array([[0.8, 0.5, 0.5], [0.1, 0.2, 0.7], [0.5, np.nan, 0.5]])
    mesh = clay_surface(np.concatenate([body, crumbs]))
    assert {4000, 4001} <= set(mesh.loose)
    assert 4002 not in mesh.loose
    assert len(mesh.loose) < 40


def test_goal_distance_is_that_from_the_goal():
    goal = np.random.default_rng(4).uniform(0.4, 0.6, (4000, 3))
    distance = goal_distance(goal, farthest=0.2, nodes=21)
    assert distance[10, 10, 10] == 0.0
    assert distance[10, 14, 10] == pytest.approx(0.1, abs=0.02)
    assert distance[0, 0, 0] == 0.2


def test_points_of_a_tool_move_evenly_with_its_gap():
    """The page mixes two surfaces of a tool with a gap."""
    tool = ToolChopsticks(position=(0, 0, 0), radius=0.03, height=0.2, gap=0.1)
    arrays = {}
    (described,) = describe_tools([tool], arrays)
    json.dumps(described)
    closed, wide = np.frombuffer(zlib.decompress(arrays[described["array"]]()), dtype="<f4").reshape(2, -1, 3)
    wanted = shape_of(tool, gap=0.3).surface(rows=16, columns=36).reshape(-1, 3)
    np.testing.assert_allclose(closed + 0.3 * (wide - closed), wanted, atol=1e-6)


def mesh_tool(directory, *, subdivisions):
    trimesh = pytest.importorskip("trimesh")
    pytest.importorskip("igl")
    made = trimesh.creation.icosphere(subdivisions=subdivisions, radius=0.05)
    mesh = Mesh(np.array(made.vertices), np.array(made.faces, dtype=np.int64))
    write_shape(directory / "ball.npz", make_grid(mesh, resolution=16))
    return ToolMesh(position=(0, 0, 0), file=directory / "ball.npz", scale=2.0)


@pytest.mark.parametrize("most", [30_000, 100])
def test_a_mesh_tool_has_its_own_triangles_or_fewer(tmp_path, monkeypatch, most):
    """The page's mesh is closed, its sides turned outwards: it encloses the tool's volume."""
    monkeypatch.setattr("cpdeform.report.page.shapes.MOST_TRIANGLES", most)
    tool, arrays = mesh_tool(tmp_path, subdivisions=3), {}
    (described,) = describe_tools([tool], arrays)
    json.dumps(described)
    vertices = np.frombuffer(zlib.decompress(arrays[described["array"]]()), dtype="<f4").reshape(-1, 3)
    triangles = np.frombuffer(zlib.decompress(arrays[described["triangles"]]()), dtype="<u4").reshape(-1, 3)
    assert described["points"] == len(vertices)
    assert (len(triangles) == 1280) == (most == 30_000)
    np.testing.assert_allclose(np.linalg.norm(vertices, axis=1), 0.1, rtol=0.02)
    a, b, c = (vertices[triangles[:, corner]].astype(float) for corner in range(3))
    assert np.einsum("fi,fi->", a, np.cross(b, c)) / 6.0 == pytest.approx(4.0 / 3.0 * np.pi * 0.1**3, rel=0.05)


def test_points_on_a_mesh_tool_leave_no_gaps(tmp_path):
    tool = mesh_tool(tmp_path, subdivisions=1)
    points = tool_surface(tool, np.array([0.5, 0.5, 0.5, 1.0, 0.0, 0.0, 0.0, 0.0]), rows=40, columns=60).reshape(-1, 3)
    assert 2400 < len(points) < 6000
    made = np.random.default_rng(0).normal(size=(2000, 3))
    places = 0.5 + 0.1 * made / np.linalg.norm(made, axis=1, keepdims=True)
    # The ball of 80 triangles is up to 0.008 flatter than a sphere.
    assert cKDTree(points).query(places)[0].max() < 0.013
