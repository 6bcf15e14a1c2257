"""Shapes from meshes: what is read and refused, distances against the primitives that they copy, goals and reliefs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from cpdeform.core.errors import InputError
from cpdeform.core.meshes.filling import even_points, fill_evenly
from cpdeform.core.meshes.goal import fitted_to_clay
from cpdeform.core.meshes.grid import make_grid, read_shape, write_shape
from cpdeform.core.meshes.mesh import Mesh
from cpdeform.core.meshes.reading import read_mesh
from cpdeform.core.meshes.relief import Relief, read_relief
from cpdeform.core.sampling import sample_particles
from cpdeform.core.scene import Scene
from cpdeform.core.shapes.box import ShapeBox
from cpdeform.core.shapes.mesh import ShapeMesh
from cpdeform.core.shapes.rod import ToolCapsule
from cpdeform.core.shapes.sphere import ShapeSphere
from cpdeform.core.task import Task

trimesh = pytest.importorskip("trimesh")
pytest.importorskip("igl")


def ball(radius: float = 1.0):
    return trimesh.creation.icosphere(subdivisions=4, radius=radius)


def mesh_of(loaded) -> Mesh:
    return Mesh(np.array(loaded.vertices), np.array(loaded.faces, dtype=np.int64))


@pytest.mark.parametrize(("suffix", "height"), [("stl", "z"), ("ply", "z"), ("obj", "y"), ("glb", "y")])
def test_files_of_every_format_stand_upright(tmp_path: Path, suffix: str, height: str) -> None:
    upright = trimesh.creation.box((1.0, 1.0, 3.0) if height == "z" else (1.0, 3.0, 1.0))
    upright.export(tmp_path / f"box.{suffix}")
    mesh, notes = read_mesh(tmp_path / f"box.{suffix}")
    assert mesh.extents == pytest.approx([1.0, 3.0, 1.0])
    assert mesh.volume() == pytest.approx(3.0, rel=1e-3)
    assert notes == []
    lying, _ = read_mesh(tmp_path / f"box.{suffix}", up="x")
    assert sorted(lying.extents) == pytest.approx([1.0, 1.0, 3.0])
    assert lying.extents[1] == pytest.approx(1.0)


def test_small_holes_are_closed_and_what_is_inside_out_is_turned(tmp_path: Path) -> None:
    broken = ball()
    broken.update_faces(np.arange(len(broken.faces)) > 4)
    broken.invert()
    broken.export(tmp_path / "broken.stl")
    mesh, notes = read_mesh(tmp_path / "broken.stl")
    assert mesh.volume() == pytest.approx(4.0 / 3.0 * np.pi, rel=0.01)
    assert any("hole" in note for note in notes)
    assert any("inside out" in note for note in notes)


def test_parts_that_overlap_are_joined() -> None:
    mesh = mesh_of(trimesh.util.concatenate([trimesh.creation.box((2.0, 1.0, 1.0)), trimesh.creation.box((1.0, 2.0, 1.0))]))
    assert mesh.volume() == pytest.approx(3.0, rel=3e-3)
    assert mesh.contains(np.array([[0.0, 0.0, 0.0], [0.9, 0.0, 0.0], [0.9, 0.9, 0.0]])).tolist() == [True, True, False]


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda whole: whole.submesh([whole.triangles_center[:, 2] < 0.2], append=True), "an open surface: 1 hole"),
        (lambda whole: trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], [[0, 1, 2], [1, 3, 2]]), "a flat sheet"),
    ],
)
def test_what_cannot_be_a_solid_is_refused(tmp_path: Path, make, message: str) -> None:
    make(ball()).export(tmp_path / "bad.ply")
    with pytest.raises(InputError, match=message):
        read_mesh(tmp_path / "bad.ply")


def test_files_that_are_no_meshes_are_refused(tmp_path: Path) -> None:
    (tmp_path / "text.stl").write_text("no mesh")
    with pytest.raises(InputError, match=r"text\.stl"):
        read_mesh(tmp_path / "text.stl")
    with pytest.raises(InputError, match=r'ends in "\.step"'):
        read_mesh(tmp_path / "part.step")
    with pytest.raises(InputError, match=r"absent\.obj: got no such file"):
        read_mesh(tmp_path / "absent.obj")


@pytest.mark.parametrize("name", ["sphere", "box", "capsule"])
def test_a_copys_distance_is_that_of_the_primitive(tmp_path: Path, name: str) -> None:
    loaded, shape = {
        "sphere": (ball(0.05), ShapeSphere(0.05)),
        "box": (trimesh.creation.box((0.1, 0.08, 0.12)), ShapeBox((0.05, 0.04, 0.06))),
        "capsule": (
            trimesh.creation.capsule(height=0.06, radius=0.04, count=[64, 64]),
            ToolCapsule(position=(0.5, 0.5, 0.5), radius=0.04, height=0.06).shape(),
        ),
    }[name]
    mesh = mesh_of(loaded).turned("z" if name == "capsule" else "y")
    write_shape(tmp_path / "shape.npz", make_grid(mesh))
    copy = ShapeMesh(read_shape(tmp_path / "shape.npz"))
    points = (torch.as_tensor(even_points(4000)) - 0.5) * 0.2
    found, gradient = copy.distance_and_gradient(points)
    expected, normal = shape.distance_and_gradient(points)
    near = expected.abs() < 0.004  # where tools are felt
    assert int(near.sum()) > 100
    assert float((found - expected)[near].abs().max()) < 1e-3
    direction = (gradient * normal).sum(dim=-1) / gradient.norm(dim=-1)
    # The grid rounds edges.
    assert float(direction[near].quantile(0.05)) > (0.9 if name == "box" else 0.99)
    assert copy.volume == pytest.approx(shape.volume, rel=0.01)
    assert float((copy.quick_distance(*points.unbind(-1)) - found)[expected < 0.02].abs().max()) < 5e-4
    far = expected > 0.03
    assert bool((found[far] > 0.02).all())
    assert torch.allclose(copy.half_extents(torch.eye(3, dtype=torch.float64)), torch.as_tensor(0.5 * mesh.extents))


def test_gradients_equal_finite_differences() -> None:
    shape = ShapeMesh(make_grid(mesh_of(ball(0.05)), resolution=16))
    points = (torch.as_tensor(even_points(500)) - 0.5) * 0.3
    _, gradient = shape.distance_and_gradient(points)
    step = 1e-7
    for axis, along in enumerate(torch.eye(3, dtype=torch.float64) * step):
        ahead, back = (shape.distance(*(points + sign * along).unbind(-1)) for sign in (1.0, -1.0))
        assert torch.allclose((ahead - back) / (2.0 * step), gradient[:, axis], atol=1e-5)


def test_shape_files_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    write_shape(tmp_path / "good.npz", make_grid(mesh_of(trimesh.creation.box((0.1, 0.1, 0.1))), resolution=12))
    with np.load(tmp_path / "good.npz") as file:
        arrays = dict(file)
    for name, value in {
        "distance": np.abs(arrays["distance"]),
        "spacing": np.float64(-1.0),
        "faces": arrays["faces"] + 10000,
        "sharp_cell": arrays["sharp_cell"] + arrays["distance"].size,
        "sharp_triangle": arrays["sharp_triangle"] - len(arrays["faces"]),
        "sharp_start": arrays["sharp_start"][::-1],
    }.items():
        np.savez(tmp_path / "bad.npz", **{**arrays, name: value})
        with pytest.raises(InputError, match=r"bad\.npz"):
            read_shape(tmp_path / "bad.npz")
    with pytest.raises(InputError, match="no such file"):
        read_shape(tmp_path / "absent.npz")


def test_a_body_from_a_mesh_is_filled(tmp_path: Path) -> None:
    write_shape(tmp_path / "ball.npz", make_grid(mesh_of(ball(0.1)), resolution=24))
    body = {"kind": "mesh", "file": str(tmp_path / "ball.npz"), "scale": 0.5, "position": (0.5, 0.2, 0.4), "particle_count": 500}
    particles = sample_particles(Scene.model_validate({"bodies": [body]}))
    distance = np.linalg.norm(particles - [0.5, 0.2, 0.4], axis=1)
    assert 0.045 < distance.max() < 0.0505
    assert Scene.model_validate({"bodies": [body]}).bodies[0].volume == pytest.approx(4.0 / 3.0 * np.pi * 0.05**3, rel=0.02)


BOARD = {"kind": "box", "position": (0.5, 0.1, 0.5), "widths": (0.3, 0.1, 0.2), "particle_count": 800}


def test_a_goal_has_the_clays_volume_and_stands_on_the_floor(tmp_path: Path) -> None:
    scene = Scene.model_validate({"bodies": [BOARD]})
    fitted = fitted_to_clay(mesh_of(trimesh.creation.box((4.0, 2.0, 1.0))), scene)
    assert np.prod(fitted.extents) == pytest.approx(0.3 * 0.1 * 0.2, rel=5e-3)
    assert fitted.corners[0][1] == pytest.approx(scene.resting_height)
    with pytest.raises(InputError, match=r"at the clay's volume of 0\.006"):
        fitted_to_clay(mesh_of(trimesh.creation.box((400.0, 1.0, 1.0))), scene)
    ball().export(tmp_path / "ball.stl")
    task = Task.from_mesh(tmp_path / "ball.stl", scene=scene, path=tmp_path / "goal.npz", step_count=4)
    goal = task.load_goal()
    assert (goal.shape, task.name, task.step_count) == ((800, 3), "goal", 4)
    radius = (0.006 * 0.75 / np.pi) ** (1.0 / 3.0)
    assert np.linalg.norm(goal - goal.mean(axis=0), axis=1).max() == pytest.approx(radius, rel=0.05)


def test_tasks_from_points(tmp_path: Path) -> None:
    points = 0.2 + 0.1 * even_points(50)
    task = Task.from_points(points, scene="writer", path=tmp_path / "cloud.npz", name="cloud")
    np.testing.assert_allclose(task.load_goal(), points, atol=2.0**-17)
    assert task.scene.tools[0].kind == "Capsule"
    with pytest.raises(InputError, match="1 of 50 points outside the domain"):
        Task.from_points(np.vstack([points[1:], [[2.0, 0.5, 0.5]]]), scene="writer", path=tmp_path / "cloud.npz")
    with pytest.raises(InputError, match="points: got shape"):
        Task.from_points(np.zeros((3, 2)), scene="writer", path=tmp_path / "cloud.npz")


def test_a_relief_keeps_the_boards_volume_and_is_deep_where_the_picture_is_dark(tmp_path: Path) -> None:
    image = pytest.importorskip("PIL.Image")
    grey = np.full((40, 80), 255, dtype=np.uint8)
    grey[:, 20:40] = 0
    image.fromarray(grey).save(tmp_path / "stripe.png")
    depths = read_relief(tmp_path / "stripe.png")
    relief = Relief(np.array([0.3, 0.05, 0.4]), np.array([0.4, 0.1, 0.2]), depths, 0.03)
    particles = fill_evenly(relief, 4000)
    lower, upper = relief.corners
    points = lower + even_points(2**15) * (upper - lower)
    assert np.prod(upper - lower) * relief.contains(points).mean() == pytest.approx(0.4 * 0.1 * 0.2, rel=5e-3)
    dark = (particles[:, 0] > 0.41) & (particles[:, 0] < 0.49)
    assert particles[dark, 1].max() < particles[~dark, 1].max() - 0.025
    image.fromarray(np.full((8, 8), 200, dtype=np.uint8)).save(tmp_path / "grey.png")
    with pytest.raises(InputError, match="one single grey"):
        read_relief(tmp_path / "grey.png")
