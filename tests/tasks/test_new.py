"""`cpdeform task new`: what it writes runs as it is; `show` draws it, `check` tells of fine detail."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from cpdeform.cli.main import app
from cpdeform.core.clearance import tool_half_extents
from cpdeform.core.errors import InputError
from cpdeform.core.meshes.filling import even_points
from cpdeform.core.sampling import sample_particles
from cpdeform.core.scene import Scene
from cpdeform.core.task import load_task
from cpdeform.run.checks.goal_detail import check_goal_detail
from cpdeform.run.checks.occupancy import filled_volume, filling_radius
from cpdeform.tasks.new import Request, new_task

trimesh = pytest.importorskip("trimesh")
pytest.importorskip("igl")
COUNT = 600


@pytest.fixture
def meshes(tmp_path: Path) -> Path:
    trimesh.creation.box((30.0, 20.0, 15.0)).export(tmp_path / "block.stl")
    trimesh.creation.icosphere(subdivisions=3).export(tmp_path / "ball.obj")
    trimesh.creation.cylinder(0.2, 3.0).export(tmp_path / "rod.glb")
    return tmp_path


def test_a_task_from_meshes_alone(meshes: Path) -> None:
    request = Request(
        name="mine",
        goal=meshes / "block.stl",
        start=meshes / "ball.obj",
        tool=meshes / "rod.glb",
        folder=meshes / "out",
        particles=COUNT,
    )
    made = new_task(request)
    assert sorted(path.name for path in (meshes / "out").iterdir()) == [
        "mine-goal.npz",
        "mine-start.npz",
        "mine-tool.npz",
        "mine.yaml",
    ]
    task = load_task(made.path)
    assert (task.scene.bodies[0].kind, task.scene.tools[0].kind) == ("mesh", "Mesh")
    clay, goal = sample_particles(task.scene), task.load_goal()
    radius = filling_radius(clay, goal)
    assert filled_volume(goal, radius) == pytest.approx(filled_volume(clay, radius), rel=0.15)
    assert goal[:, 1].min() == pytest.approx(task.scene.resting_height, abs=0.01)
    extents = np.ptp(goal, axis=0)
    assert extents / extents[0] == pytest.approx([1.0, 0.5, 20.0 / 30.0], abs=0.06)
    assert any("scaled to the clay's volume" in note for note in made.notes)
    with pytest.raises(InputError, match=r"mine\.yaml, which exists"):
        new_task(request)


def test_a_block_and_two_tools_where_nothing_else_is_given(meshes: Path) -> None:
    task = new_task(Request(name="plain", goal=meshes / "ball.obj", folder=meshes, particles=COUNT)).task
    (body,) = task.scene.bodies
    # The outermost particles lie half a gap inside of the ball's surface.
    assert body.volume == pytest.approx(4.0 / 3.0 * np.pi * (0.5 * np.ptp(task.load_goal()[:, 0])) ** 3, rel=0.3)
    assert [tool.kind for tool in task.scene.tools] == ["Box", "Box"]
    assert all(tool.movable for tool in task.scene.tools)
    # Tools that stand upright stay out of the floor.
    for tool in task.scene.tools:
        reach = float(tool_half_extents(tool, torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=torch.float64))[1])
        assert tool.lower_bound[1] - reach > 0.0
        assert tool.lower_bound[1] - reach == pytest.approx(task.scene.resting_height, abs=0.011)
        assert tool.position[1] >= tool.lower_bound[1]


def test_a_picture_becomes_a_relief_for_a_pen(tmp_path: Path) -> None:
    image = pytest.importorskip("PIL.Image")
    grey = np.full((30, 60), 255, dtype=np.uint8)
    grey[10:20] = 0
    image.fromarray(grey).save(tmp_path / "bar.png")
    task = new_task(Request(name="bar", goal=tmp_path / "bar.png", folder=tmp_path, particles=COUNT)).task
    assert task.scene.tools[0].kind == "Capsule"
    goal = task.load_goal()
    middle = np.abs(goal[:, 2] - 0.5) < 0.02
    assert goal[middle, 1].max() < goal[~middle, 1].max() - 0.015


@pytest.mark.parametrize("name", ["../up", "", "a b", "-x"])
def test_names_that_are_no_file_names(meshes: Path, name: str) -> None:
    with pytest.raises(InputError, match="NAME: got"):
        new_task(Request(name=name, goal=meshes / "ball.obj", folder=meshes))


def test_the_command_line_makes_shows_and_checks(meshes: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(meshes)
    invoke = CliRunner().invoke
    made = invoke(app, ["task", "new", "cup", "--goal", "block.stl", "--particles", str(COUNT)])
    assert made.exit_code == 0, made.output
    assert "cpdeform run cup.yaml" in made.output
    shown = invoke(app, ["task", "show", "cup.yaml", "--out", "cup.png"])
    assert shown.exit_code == 0, shown.output
    assert (meshes / "cup.png").stat().st_size > 10_000
    checked = invoke(app, ["task", "check", "cup.yaml"])
    assert checked.exit_code == 0, checked.output
    refused = invoke(app, ["task", "new", "cup", "--goal", "block.stl", "--up", "w"])
    assert refused.exit_code == 2
    assert "--up: got w, expected x, y or z" in refused.output


def test_thin_walls_and_narrow_hollows_are_told() -> None:
    body = {"kind": "box", "position": (0.5, 0.2, 0.5), "widths": (0.2, 0.2, 0.2), "particle_count": 4000}
    ball = {"kind": "Sphere", "radius": 0.03, "position": (0.5, 0.5, 0.5), "action_scale": (0.01, 0.01, 0.01)}
    scene = Scene.model_validate({"bodies": [body], "tools": [ball]})
    points = even_points(4000)
    block = 0.4 + 0.2 * points
    line = np.linspace(0.3, 0.7, 60)
    sheet = np.stack(np.meshgrid(line, [0.303, 0.309], line, indexing="ij"), axis=-1).reshape(-1, 3)
    slit = block[np.abs(block[:, 0] - 0.5) > 0.025]
    assert check_goal_detail(scene, block) == []
    (thin,) = check_goal_detail(scene, sheet)
    assert "thinner than two grid cells (0.0312)" in thin.what
    (narrow,) = check_goal_detail(scene, slit)
    assert "narrower than the thinnest tool (0.06)" in narrow.what
    assert {thin.severity, narrow.severity} == {"note"}
