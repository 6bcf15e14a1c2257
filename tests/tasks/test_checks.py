"""What `cpdeform task check` tells, on scenes that have one fault each, and the physics that the limits stand for."""

from __future__ import annotations

import json
import math
import re
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from cpdeform.backends.warp.simulator import SimulatorWarp
from cpdeform.cli.main import app
from cpdeform.core.errors import InputError
from cpdeform.core.plugins import Registry, load_registry
from cpdeform.core.sampling import sample_particles
from cpdeform.core.scene import Scene, Tool
from cpdeform.core.task import Task, list_variants, read_task, task_path
from cpdeform.run.checks.bodies import check_near_bodies, gap
from cpdeform.run.checks.check import check_task, check_tools, warn_about_tools
from cpdeform.run.checks.finding import Finding
from cpdeform.run.checks.goal_height import check_goal_below_floor, check_goal_floating, check_goal_inside_floor
from cpdeform.run.checks.goal_reach import check_goal_reach
from cpdeform.run.checks.goal_rest import check_goal_rest
from cpdeform.run.checks.goal_volume import check_goal_volume
from cpdeform.run.checks.occupancy import filled_volume, filling_radius
from cpdeform.run.checks.tool_size import bounding_radius, contact_reach, thickness
from cpdeform.run.checks.tool_speed import check_tool_speed
from cpdeform.run.checks.tool_thickness import check_tool_thickness

BETWEEN_NODES = 20.5 / 64
BLOCK = {"kind": "box", "position": (0.5, 0.4, 0.5), "widths": (0.1, 0.06, 0.1), "particle_count": 800}
TOOLS: dict[str, dict[str, Any]] = {
    "Sphere": {"radius": 0.05},
    "Capsule": {"radius": 0.03, "height": 0.1},
    "RollingPin": {"radius": 0.03, "height": 0.1},
    "Chopsticks": {"radius": 0.02, "height": 0.1},
    "Box": {"half_extents": (0.05, 0.02, 0.04), "rounding": 0.01},
    "Cylinder": {"radius": 0.05, "half_height": 0.03},
    "Torus": {"major_radius": 0.05, "tube_radius": 0.02},
}
THIN: dict[str, dict[str, Any]] = {
    "plate": {"kind": "Box", "half_extents": (0.2, 0.002, 0.2)},
    "disc": {"kind": "Cylinder", "radius": 0.2, "half_height": 0.002},
    "rod": {"kind": "Capsule", "radius": 0.002, "height": 0.2, "rotation_wxyz": (math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5))},
}


def scene_with(*tools: dict[str, Any], bodies: Any = (BLOCK,), **changes: Any) -> Scene:
    placed = [{"position": (0.5, BETWEEN_NODES, 0.5 + 0.5 / 64), **tool} for tool in tools]
    return Scene.model_validate({"bodies": list(bodies), "tools": placed, **changes})


def tool_of(kind: str) -> Tool:
    return scene_with({"kind": kind, **TOOLS[kind]}).tools[0]


def only(findings: list[Finding]) -> Finding:
    (finding,) = findings
    assert finding.what.endswith(".")
    assert finding.remedy.endswith(".")
    return finding


def box_points(position: tuple[float, float, float], widths: tuple[float, float, float], count: int = 4000) -> Any:
    return np.asarray(position) + np.random.default_rng(0).uniform(-0.5, 0.5, (count, 3)) * np.asarray(widths)


def moved(points: Any, *by: float) -> Any:
    return points + np.asarray(by)


def task_with(tmp_path: Path, scene: Scene, goal: Any, **changes: Any) -> Task:
    np.savez(tmp_path / "goal.npz", position=goal)
    return Task(name="checked", scene=scene, goal=tmp_path / "goal.npz", **changes)


# Tools --------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", TOOLS)
def test_lengths_of_tools_agree_with_their_signed_distance(kind: str) -> None:
    from cpdeform.core.signed_distance import signed_distance

    tool = tool_of(kind)
    points = torch.as_tensor(np.random.default_rng(0).uniform(-0.2, 0.2, (200_000, 3)))
    pose = torch.tensor([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.06], dtype=torch.float64)
    distance = signed_distance(tool, pose, points)
    deepest, farthest = -float(distance.min()), float(points[distance <= 0.0].norm(dim=1).max())
    assert thickness(tool) == pytest.approx(2.0 * deepest, rel=0.1)
    assert 0.93 * bounding_radius(tool) < farthest <= bounding_radius(tool) + 1e-9


def fallen_through(scene: Scene) -> float:
    """Part of the clay that is below the tool after a while."""
    simulator = SimulatorWarp(scene, device="cpu")
    trajectory = simulator.rollout(simulator.initial_state(), torch.zeros(1, 60, 0))
    return float((trajectory.positions[0, -1, :, 1] < BETWEEN_NODES - 0.01).float().mean())


def test_a_plate_below_the_limit_lets_clay_fall_through_and_one_above_carries_it() -> None:
    thin = scene_with(THIN["plate"])
    thick = scene_with({**THIN["plate"], "half_extents": (0.2, 0.0125, 0.2)})
    assert fallen_through(thin) == 1.0
    assert fallen_through(thick) == 0.0
    assert only(check_tool_thickness(thin)).severity == "error"
    assert check_tool_thickness(thick) == []


@pytest.mark.parametrize("name", THIN)
def test_a_fixed_tool_that_covers_no_node_is_refused(name: str) -> None:
    scene = scene_with(THIN[name])
    finding = only(check_tools(scene))
    assert (finding.severity, finding.kind, finding.where) == ("error", "tool thickness", "scene.tools.0")
    with pytest.raises(InputError, match=r"scene\.tools\.0: got This fixed .* can never be felt.*grid_size"):
        warn_about_tools(scene)


@pytest.mark.parametrize("name", THIN)
def test_a_thin_tool_on_a_node_or_moving_is_warned_of(name: str) -> None:
    on_node = scene_with({**THIN[name], "position": (0.5, 20.0 / 64, 0.5)})
    moving = scene_with({**THIN[name], "action_scale": (0.01, 0.01, 0.01)})
    for scene in (on_node, moving):
        assert only(check_tools(scene)).severity == "warning"
        with pytest.warns(UserWarning, match=r"scene\.tools\.0: .*0\.004 thick, and clay passes through") as caught:
            warn_about_tools(scene)
        assert len(caught) == 1


def test_the_least_thickness_depends_on_grid_and_softness() -> None:
    plate = {**THIN["plate"], "half_extents": (0.2, 0.01, 0.2)}
    assert only(check_tools(scene_with(plate))).severity == "warning"
    assert check_tools(scene_with(plate, grid_size=128)) == []
    assert check_tools(scene_with(plate, softness=300.0)) == []
    assert contact_reach(scene_with(softness=0.0)) == 0.0


@pytest.mark.parametrize("scale", [0.3, 1.0])
def test_a_tool_faster_than_the_grid_is_warned_of(scale: float) -> None:
    ball = {"kind": "Sphere", "radius": 0.03, "action_scale": (scale, 0.0, 0.0)}
    finding = only(check_tools(scene_with(ball)))
    assert (finding.severity, finding.kind) == ("warning", "tool speed")
    assert f"{scale / 19 * 64:.3g} grid cells" in finding.what
    assert check_tool_speed(scene_with({**ball, "action_scale": (0.1, 0.1, 0.1)})) == []
    assert check_tool_speed(scene_with({**ball, "action_scale": (0.1, 0.1, 0.1)}, substeps=10)) != []


@pytest.mark.parametrize(
    ("kind", "still", "fast"),
    [
        ("RollingPin", (0.7, 0.1, 0.001), (20.0, 0.0, 0.0)),
        ("Chopsticks", (0.02,) * 7, (0.0,) * 6 + (0.4,)),
        ("Box", (0.01,) * 6, (0.0, 0.0, 0.0, 0.0, 3.0, 0.0)),
    ],
)
def test_turning_and_gripping_count_as_motion(kind: str, still: tuple[float, ...], fast: tuple[float, ...]) -> None:
    tool = {"kind": kind, **TOOLS[kind]}
    assert check_tool_speed(scene_with({**tool, "action_scale": still})) == []
    assert only(check_tool_speed(scene_with({**tool, "action_scale": fast}))).kind == "tool speed"


# Bodies -------------------------------------------------------------------------------------------------------------------


def two_blocks(cells: float) -> Scene:
    blocks = [{**BLOCK, "position": (0.4, 0.4, 0.5)}, {**BLOCK, "position": (0.5 + cells / 64, 0.4, 0.5)}]
    return scene_with(bodies=blocks, gravity_parameter=(0.0, 0.0, 0.0))


@pytest.mark.parametrize(("cells", "severity"), [(0.5, "note"), (1.5, "warning"), (2.5, None), (0.0, None)])
def test_near_bodies_are_told_of(cells: float, severity: str | None) -> None:
    findings = check_near_bodies(two_blocks(cells))
    assert [finding.severity for finding in findings] == ([severity] if severity else [])
    if severity:
        assert f"0 and 1 start {cells:.2g} grid cells apart" in findings[0].what


@pytest.mark.parametrize(("cells", "sticks"), [(0.5, True), (2.5, False)])
def test_blocks_thrown_apart_stick_below_the_limit(cells: float, sticks: bool) -> None:
    scene = two_blocks(cells)
    simulator = SimulatorWarp(scene, device="cpu")
    state = simulator.initial_state()
    state.velocity[0, :800, 0] = -1.0
    state.velocity[0, 800:, 0] = 1.0
    positions = simulator.rollout(state, torch.zeros(1, 40, 0)).positions[0, :, :, 0]
    width = positions[:, 800:].mean(dim=1) - positions[:, :800].mean(dim=1)
    free = 2.0 * 1e-4 * 19 * 40  # what they would move apart by
    assert (float(width[-1] - width[0]) < 0.9 * free) == sticks


def test_gaps_between_balls_and_blocks() -> None:
    ball = {"kind": "sphere", "radius": 0.05, "particle_count": 10}
    scene = scene_with(
        bodies=[
            {**ball, "position": (0.3, 0.4, 0.5)},
            {**ball, "position": (0.6, 0.8, 0.5)},
            {**BLOCK, "position": (0.45, 0.4, 0.5)},
        ]
    )
    balls_apart, ball_to_block = gap(scene.bodies[0], scene.bodies[1]), gap(scene.bodies[0], scene.bodies[2])
    assert balls_apart == pytest.approx(0.4)
    assert ball_to_block == pytest.approx(0.05)


# Goal ---------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("widths", [(0.3, 0.1, 0.3), (0.6, 0.06, 0.06), (0.2, 0.2, 0.2)])
def test_filled_volume_is_that_of_the_body_whatever_the_density(widths: tuple[float, float, float]) -> None:
    dense, sparse = (box_points((0.5, 0.5, 0.5), widths, count) for count in (20000, 5000))
    radius = filling_radius(dense, sparse)
    exact = math.prod(widths)
    assert filled_volume(dense, radius) == pytest.approx(exact, rel=0.13)
    assert filled_volume(sparse, radius) == pytest.approx(exact, rel=0.2)


@pytest.mark.parametrize(("factor", "word"), [(0.7, "less"), (1.0, None), (1.4, "more")])
def test_a_goal_of_another_volume_is_told_of(factor: float, word: str | None) -> None:
    clay = box_points((0.5, 0.2, 0.5), (0.2, 0.2, 0.2))
    goal = box_points((0.5, 0.2, 0.5), (0.3, 0.2, 0.2 * factor / 1.5))
    findings = check_goal_volume(clay, goal)
    if word is None:
        assert findings == []
    else:
        finding = only(findings)
        assert word in finding.what
        scale = float(finding.remedy.split("lengths by ")[1].split(",")[0])
        assert scale**3 * factor == pytest.approx(1.0, abs=0.1)


def test_clay_comes_to_rest_at_the_floors_height() -> None:
    scene = scene_with(bodies=[{**BLOCK, "position": (0.5, 0.12, 0.5)}])
    simulator = SimulatorWarp(scene, device="cpu")
    height = float(simulator.rollout(simulator.initial_state(), torch.zeros(1, 60, 0)).positions[0, -1, :, 1].min())
    assert scene.resting_height == pytest.approx(0.047, abs=1e-3)
    assert height == pytest.approx(scene.resting_height, abs=0.5 / 64)


def test_a_floating_goal_needs_something_to_hold_it() -> None:
    ball = {"kind": "Sphere", "radius": 0.03, "action_scale": (0.01, 0.01, 0.01)}
    stand = {"kind": "Cylinder", "radius": 0.1, "half_height": 0.1, "position": (0.5, 0.2, 0.5)}
    hanging = box_points((0.5, 0.4, 0.5), (0.2, 0.2, 0.2))
    assert only(check_goal_floating(scene_with(ball), hanging)).severity == "warning"
    assert only(check_goal_floating(scene_with(ball, ball), hanging)).severity == "note"
    assert check_goal_floating(scene_with(ball, stand), hanging) == []
    assert check_goal_floating(scene_with(ball, ground_height=0.27), hanging) == []
    assert check_goal_floating(scene_with(ball, gravity_parameter=(0.0, 0.0, 0.0)), hanging) == []
    resting = np.concatenate([moved(hanging, 0.0, -0.25, 0.0), moved(hanging, 0.3, 0.0, 0.0)])
    assert "50%" in only(check_goal_floating(scene_with(ball), resting)).what


def test_a_goal_below_the_floor_is_told_of_unless_clay_starts_there() -> None:
    scene, goal = scene_with(), box_points((0.5, 0.05, 0.5), (0.2, 0.1, 0.2))
    high, low = box_points((0.5, 0.4, 0.5), (0.2, 0.1, 0.2)), box_points((0.5, 0.05, 0.5), (0.1, 0.1, 0.2))
    finding = only(check_goal_below_floor(scene, high, goal))
    assert "0.0469" in finding.what
    assert check_goal_below_floor(scene, low, goal) == []
    assert check_goal_below_floor(scene, high, moved(goal, 0.0, 0.047, 0.0)) == []


def test_a_goal_inside_the_floor_is_told_of_where_no_clay_starts() -> None:
    scene, height = scene_with(ground_height=0.27), 20.0 / 64.0
    clay = box_points((0.5, height - 1.5 / 64.0 + 0.05, 0.5), (0.2, 0.1, 0.2))
    wide = box_points((0.5, height - 1.5 / 64.0 + 0.05, 0.5), (0.3, 0.1, 0.2))
    finding = only(check_goal_inside_floor(scene, clay, wide))
    assert finding.severity == "note"
    # A third of the goal is beside the clay; of its height of 6.4 cells one is more than half a cell inside the layer.
    share = int(re.match(r"(\d+)%", finding.what)[1])  # type: ignore[index]
    assert share == pytest.approx(100.0 / 3.0 / 6.4, abs=1.5)
    assert check_goal_inside_floor(scene, clay, clay) == []
    up = 1.5 / 64.0
    assert check_goal_inside_floor(scene, moved(clay, 0.0, up, 0.0), moved(wide, 0.0, up, 0.0)) == []


def test_a_goal_out_of_reach_is_told_of(tmp_path: Path) -> None:
    ball = {"kind": "Sphere", "radius": 0.03, "action_scale": (0.01, 0.01, 0.01)}
    clay = sample_particles(scene_with(ball))
    goal = moved(clay, 0.2, 0.0, 0.0)
    bounded = task_with(tmp_path, scene_with({**ball, "upper_bound": (0.4, 1.0, 1.0)}), goal, step_count=50)
    assert only(check_goal_reach(bounded, clay, goal)).where == "scene.tools"
    short = task_with(tmp_path, scene_with(ball), goal, step_count=5)
    assert only(check_goal_reach(short, clay, goal)).where == "step_count"
    assert check_goal_reach(task_with(tmp_path, scene_with(ball), goal, step_count=50), clay, goal) == []
    assert only(check_goal_reach(task_with(tmp_path, scene_with(THIN["plate"]), goal), clay, goal)).severity == "error"


@pytest.mark.parametrize(("overhang", "falls"), [(0.0, False), (0.12, True)])
def test_a_goal_that_tips_over_is_told_of(overhang: float, falls: bool) -> None:
    scene = scene_with(material={"youngs_modulus": 2000.0, "yield_stress": 20.0}, grid_size=32, ground_height=0.1)
    foot, top = scene.resting_height, 0.12
    stem = box_points((0.5, foot + top / 2, 0.5), (0.1, top, 0.1), 500)
    roof = box_points((0.5 + overhang, foot + top + 0.05, 0.5), (0.25, 0.1, 0.1), 1000)
    findings = check_goal_rest(scene, np.concatenate([stem, roof]))
    assert bool(findings) == falls
    if falls:
        assert only(findings).severity == "note"
        assert "does not keep its shape" in findings[0].what


def test_without_a_simulator_no_goal_is_let_go() -> None:
    scene = scene_with()
    empty = Registry(load_registry().manager, (), ())
    assert check_goal_rest(scene, box_points((0.5, 0.8, 0.5), (0.1, 0.1, 0.1)), registry=empty) == []


# Whole tasks --------------------------------------------------------------------------------------------------------------

SHIPPED = sorted(load_registry().names("task"))


@pytest.mark.parametrize("name", [name for name in SHIPPED if not name.startswith("toy")])
def test_the_tasks_that_come_with_it_have_no_fault(name: str) -> None:
    path = task_path(name, registry=load_registry())
    variants = list_variants(path) or [None]
    # the variants of a task share its scene; the first and the last stand for their goals
    for variant in {variants[0], variants[-1]}:
        task = read_task(path, variant=variant)
        notes = check_task(task)
        assert [finding for finding in notes if finding.severity != "note"] == []
        kinds = {"move": {"goal floating"}, "triple-move": {"goal floating"}, "table": {"near bodies"}}
        kinds["chopsticks"] = {"goal at rest"}  # the goal is held up by the chopsticks
        found = {finding.kind for finding in notes}
        assert found - {"goal detail", "goal inside the floor"} == kinds.get(name, set())
        # PlasticineLab's bodies begin at the domain's lower face, two cells inside the floor's boundary layer.
        assert ("goal inside the floor" in found) == (name in {"chopsticks", "move++", "rope"})
        # Some of the paper's goals are thin: ends of ropes, legs of a table.
        assert "goal detail" not in found or name in {"chopsticks", "rope", "rope++", "table"}
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            warn_about_tools(task.scene)


def test_the_command_line_tells_all_and_fails(tmp_path: Path) -> None:
    scene = scene_with(THIN["plate"], {"kind": "Sphere", "radius": 0.03, "action_scale": (1.0, 1.0, 1.0)})
    np.savez(tmp_path / "goal.npz", position=moved(sample_particles(scene), 0.0, 0.1, 0.0))
    content = {"name": "faulty", "scene": scene.model_dump(mode="json"), "goal": "goal.npz"}
    (tmp_path / "faulty.yaml").write_text(json.dumps(content))
    result = CliRunner().invoke(app, ["task", "check", str(tmp_path / "faulty.yaml"), "--json"])
    *lines, last = result.stdout.splitlines()
    assert result.exit_code == 1
    assert [line.split(": ")[:3] for line in lines] == [
        ["error", "tool thickness", "scene.tools.0"],
        ["warning", "tool speed", "scene.tools.1.action_scale"],
        ["warning", "goal floating", "goal"],
    ]
    found = json.loads(last)
    assert not found["passed"]
    assert [finding["kind"] for finding in found["findings"]] == ["tool thickness", "tool speed", "goal floating"]
    assert all(finding["remedy"] for finding in found["findings"])
    good = CliRunner().invoke(app, ["task", "check", "writer-v2"])
    assert (good.exit_code, good.stdout) == (0, "writer-v2: nothing is wrong\n")
