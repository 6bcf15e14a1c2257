from __future__ import annotations

import builtins
import gc
import sys

import imageio.v2
import numpy as np
import pytest
import torch
from scipy.spatial import KDTree

import cpdeform
from cpdeform.core.errors import InputError
from cpdeform.core.plugins import load_registry
from cpdeform.core.scene import (
    ToolBox,
    ToolCapsule,
    ToolChopsticks,
    ToolCylinder,
    ToolSphere,
    ToolTorus,
)
from cpdeform.core.signed_distance import signed_distance
from cpdeform.report import draw_run
from cpdeform.report.animation import _between, _moments, draw_animation
from cpdeform.report.draw import draw_chosen
from cpdeform.report.pictures import draw_picture
from cpdeform.report.render import fit_camera, render
from cpdeform.report.shapes import covering, tool_surface
from cpdeform.run.deform import deform
from cpdeform.run.record import load_record

TOOLS = [
    ToolSphere(position=(0, 0, 0), radius=0.1),
    ToolCapsule(position=(0, 0, 0), radius=0.05, height=0.2),
    ToolBox(position=(0, 0, 0), half_extents=(0.1, 0.05, 0.2)),
    ToolBox(position=(0, 0, 0), half_extents=(0.1, 0.05, 0.2), rounding=0.02),
    ToolCylinder(position=(0, 0, 0), radius=0.1, half_height=0.05),
    ToolTorus(position=(0, 0, 0), major_radius=0.1, tube_radius=0.03),
    ToolChopsticks(position=(0, 0, 0), radius=0.03, height=0.2, gap=0.1),
]


@pytest.mark.parametrize("tool", TOOLS, ids=lambda tool: tool.kind)
def test_tool_surfaces_are_the_tools(tool):
    """Every point lies on the zero of the signed distance, also of a turned tool, and the surface is closed."""
    turn = np.array([0.5, 0.5, -0.1, 0.7])
    pose = np.array([0.3, 0.4, 0.5, *(turn / np.linalg.norm(turn)), 0.15])
    surface = tool_surface(tool, pose, rows=200, columns=200)
    distance = signed_distance(tool, torch.as_tensor(pose), torch.as_tensor(surface.reshape(-1, 3)))
    assert float(distance.abs().max()) < 2e-4
    np.testing.assert_allclose(surface[:, 0], surface[:, -1], atol=1e-12)
    # The divergence theorem on the closed mesh gives the volume.
    a, b, c, d = surface[:-1, :-1], surface[1:, :-1], surface[1:, 1:], surface[:-1, 1:]
    parts = [np.einsum("...i,...i->...", x - pose[:3], np.cross(y - pose[:3], z - pose[:3])) for x, y, z in ((a, b, c), (a, c, d))]
    assert abs(sum(part.sum() for part in parts)) / 6.0 == pytest.approx(volume(tool), rel=0.02)


@pytest.mark.parametrize("tool", TOOLS, ids=lambda tool: tool.kind)
def test_tools_are_covered_without_gaps(tool):
    """A grid of points is dense on some faces and has gaps on others; what covers it has none, and lies on the tool."""
    pose = np.array([0.3, 0.4, 0.5, 1.0, 0.0, 0.0, 0.0, 0.15])
    points = covering(tool_surface(tool, pose), distance=0.004)
    distance = signed_distance(tool, torch.as_tensor(pose), torch.as_tensor(points))
    assert float(distance.abs().max()) < 1e-3
    fine = tool_surface(tool, pose, rows=150, columns=150).reshape(-1, 3)
    assert float(KDTree(points).query(fine)[0].max()) < 0.004


def volume(tool):
    match tool:
        case ToolSphere():
            return 4 / 3 * np.pi * tool.radius**3
        case ToolCapsule():
            return 4 / 3 * np.pi * tool.radius**3 + np.pi * tool.radius**2 * tool.height
        case ToolChopsticks():
            return 2 * (4 / 3 * np.pi * tool.radius**3 + np.pi * tool.radius**2 * tool.height)
        case ToolCylinder():
            return np.pi * tool.radius**2 * 2 * tool.half_height
        case ToolTorus():
            return 2 * np.pi**2 * tool.major_radius * tool.tube_radius**2
    x, y, z = (2 * half for half in tool.half_extents)
    r = tool.rounding
    return x * y * z + 2 * r * (x * y + y * z + z * x) + np.pi * r**2 * (x + y + z) + 4 / 3 * np.pi * r**3


def ball(centre, radius, count=400, seed=0):
    points = np.random.default_rng(seed).uniform(-1.0, 1.0, (4 * count, 3))
    return np.asarray(centre) + radius * points[np.linalg.norm(points, axis=1) < 1.0][:count]


def test_the_nearer_thing_hides_the_farther():
    """Of two balls of clay in a line the nearer one is seen, as of two crumbs; beside them there is nothing."""
    camera = fit_camera(np.array([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]]), azimuth=0.0, elevation=0.0, aspect=1.0)
    balls = np.concatenate([ball((0.0, 0.0, 0.0), 0.3), ball((0.0, 0.0, 0.9), 0.3)])
    for particles in (balls, np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]])):
        half = len(particles) // 2
        colours = np.repeat([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], [half, len(particles) - half], axis=0)
        for order in (slice(None), slice(None, None, -1)):
            picture = render(camera, width=41, particles=particles[order], colours=colours[order], spacing=0.07)
            assert picture.shape == (41, 41, 4)
            red, green, _, opacity = picture[20, 20]
            assert green > 0.2 > red
            assert opacity == 1.0
            assert picture[0, 0, 3] == 0.0


def test_a_tool_behind_clay_is_seen_through_it():
    camera = fit_camera(np.array([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]]), azimuth=0.0, elevation=0.0, aspect=1.0)
    particles = ball((0.0, 0.0, 0.5), 0.3)
    pose = np.array([0.0, 0.0, -0.5, 1.0, 0.0, 0.0, 0.0, 0.0])
    tool = tool_surface(ToolSphere(position=(0, 0, 0), radius=0.1), pose)
    options = {"width": 61, "particles": particles, "colours": np.tile([1.0, 0.5, 0.2], (len(particles), 1))}
    without, behind = (render(camera, **options, tools=tools)[30, 30] for tools in ((), (tool,)))
    in_front = render(camera, **options, tools=(tool + np.array([0.0, 0.0, 2.0]),))[30, 30]
    assert without[0] > behind[0] > in_front[0]
    assert without[2] < behind[2] < in_front[2]


def panels(path):
    """The four panels without titles and colour bars."""
    picture = imageio.v2.imread(path)[..., :3].astype(float)
    height, width = picture.shape[:2]
    return picture, [picture[height // 5 : 4 * height // 5, width * i // 4 : width * (i + 1) // 4] for i in range(4)]


# imageio's reader of videos (not its writer) leaves its pipes open.
@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")
def test_picture_and_animation(record, monkeypatch):
    monkeypatch.setattr("cpdeform.report.animation.MOST_BETWEEN", 1)
    directory = record()
    path = draw_run(directory)
    assert path == directory / "picture.png"
    picture, parts = panels(path)
    assert picture.shape[0] > 400
    assert picture.shape[1] > 1500
    for part in parts:
        assert part.std() > 10.0
        assert (part < 250).any(axis=-1).mean() > 0.02
    with imageio.v2.get_reader(directory / "animation.mp4") as reader:
        frames = list(reader.iter_data())
    del reader
    gc.collect()
    # 2 stages of 5 steps, start included, and the last one held for a second.
    assert len(frames) == 2 * 6 + 6
    assert np.abs(frames[0].astype(float) - frames[10]).mean() > 0.5
    assert {path.name for path in directory.iterdir() if path.name.startswith(".")} == set()


def test_pictures_come_from_the_record_alone(record, toy_task_file):
    directory = record(stages=1)
    (toy_task_file.parent / "goal.npz").unlink()
    toy_task_file.unlink()
    moved = directory.rename(directory.with_name("moved"))
    assert draw_picture(load_record(moved)) == moved / "picture.png"


def test_no_priorities_and_no_executed_plan(record, tmp_path):
    from cpdeform_toy.parts import PlacerFixedToy

    class Nowhere(PlacerFixedToy):
        def ask(self, stage):
            return []

    directory = record(placer=Nowhere())
    _, parts = panels(draw_run(directory))
    assert all(part.std() > 10.0 for part in parts)
    assert not list(directory.glob("animation*"))


def test_gif_without_ffmpeg(record, monkeypatch):
    monkeypatch.setattr("cpdeform.report.animation._has_ffmpeg", lambda: False)
    monkeypatch.setattr("cpdeform.report.animation.MOST_BETWEEN", 1)
    directory = record(stages=1)
    path = draw_animation(load_record(directory))
    assert path == directory / "animation.gif"
    assert len(imageio.v2.mimread(path)) >= 6


def test_frames_between_steps_do_not_lead_from_stage_to_stage():
    moments = _moments([(0, 0), (0, 1), (1, 0), (1, 1)], 2)
    assert moments == [(0, 0.0), (0, 0.5), (0, 1.0), (1, 0.0), (1, 0.5), (1, 1.0)]
    np.testing.assert_allclose(_between(np.array([[0.0, 2.0], [1.0, 4.0]]), 0.25), [0.25, 2.5])
    np.testing.assert_allclose(_between(np.array([[0.0, 2.0], [1.0, 4.0]]), 1.0), [1.0, 4.0])


def test_sheet_and_curves(record, tmp_path):
    directory = record()
    picture, curves, sheet = draw_chosen(directory, ("picture", "curves", "sheet"), camera="top")
    assert [path.name for path in (picture, curves, sheet)] == ["picture.png", "curves.png", "sheet.png"]
    rows = np.array_split(imageio.v2.imread(sheet)[..., :3].astype(float), 2)
    assert all(row.std() > 10.0 for row in rows)
    assert imageio.v2.imread(curves).std() > 10.0
    for camera in ("sideways", (1.0, 2.0, 3.0), (0.0, 120.0), "nan,1"):
        with pytest.raises(InputError, match="camera"):
            draw_chosen(directory, ("picture",), camera=camera)


def test_public_render(record):
    """Clay from above is wider than from the front; tools are drawn where a scene says what they are."""
    recorded = load_record(record(stages=1))
    state, scene = recorded.state, recorded.task.scene
    plain = cpdeform.render(state, width=120)
    assert plain.dtype == np.uint8
    assert plain.shape[1:] == (120, 3)
    assert (plain[0] == 255).all()
    blue = cpdeform.render(state, scene=scene, width=120).astype(int)
    assert (blue[..., 2] > blue[..., 0] + 20).any()
    assert not (plain[..., 2].astype(int) > plain[..., 0].astype(int) + 20).any()
    board = np.random.default_rng(0).uniform(0.0, 1.0, (3000, 3)) * [1.0, 0.1, 1.0]
    shares = [(cpdeform.render(board, camera=camera, width=120) < 250).any(axis=-1).mean() for camera in ("top", "front")]
    assert shares[0] > 2.0 * shares[1]
    for wrong in ({"values": np.zeros(3)}, {"width": 0}, {"camera": "nowhere"}):
        with pytest.raises(InputError):
            cpdeform.render(state, **wrong)
    for nothing in (state.fork(2), np.zeros((0, 3)), np.full((4, 3), np.nan)):
        with pytest.raises(InputError, match="state"):
            cpdeform.render(nothing)


def test_a_result_shows_itself(toy_task_file, toy_entry_points, monkeypatch):
    result = deform(
        str(toy_task_file), simulator="toy", ot_solver="toy", placer="toy", registry=load_registry(toy_entry_points), stages=1
    )
    text = result._repr_html_()
    assert text.count("data:image/png;base64,") == 3
    assert f"{result.loss_final:.4g}" in text
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    assert "data:image" not in result._repr_html_()


def test_no_pyplot(record, monkeypatch):
    """No figure is left in matplotlib's global state: pyplot is never imported."""
    genuine = builtins.__import__

    def guarded(name, *arguments, **options):
        assert name != "matplotlib.pyplot"
        return genuine(name, *arguments, **options)

    monkeypatch.setattr(builtins, "__import__", guarded)
    draw_picture(load_record(record(stages=1)))


def test_nothing_to_draw(tmp_path):
    with pytest.raises(InputError, match=r"no run\.json"):
        draw_run(tmp_path)
