"""`cpdeform run --resume`: a run goes on from its record, on any backend, as if it had not been broken off."""

from __future__ import annotations

import dataclasses
import json
import shutil

import numpy as np
import pytest
import torch
import yaml
from typer.testing import CliRunner

from cpdeform.backends.warp.simulator import SimulatorWarp
from cpdeform.cli.main import app
from cpdeform.core.plugins import load_registry
from cpdeform.core.scene import Scene
from cpdeform.planning.optimizer import TrajectoryOptimizer
from cpdeform.run.deform import deform
from cpdeform.run.record import load_record

PARTS = ["--backend", "toy", "--ot", "toy", "--placer", "toy", "--iterations", "3"]
BOARD = {
    "bodies": [{"kind": "box", "position": [0.5, 0.08, 0.5], "widths": [0.2, 0.16, 0.2], "particle_count": 500}],
    "tools": [{"kind": "Sphere", "radius": 0.06, "position": [0.5, 0.221, 0.5], "action_scale": [0.005, 0.005, 0.005]}],
    "grid_size": 32,
    "gravity_parameter": [0.0, 0.0, 0.0],
    "substeps": 5,
}


@pytest.fixture
def directory(tmp_path, monkeypatch, toy_distribution, toy_task_file):
    """The current directory, with a task file in it and the toy parts installed."""
    monkeypatch.syspath_prepend(str(toy_distribution))
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def half(directory):
    """The record of the first of two stages."""
    assert invoke("run", "shift.yaml", *PARTS, "--stages", 1, "--seed", 5, "--out", "half").exit_code == 0
    return directory / "half"


def invoke(*arguments):
    pictures = [] if "--no-pictures" in arguments or arguments[0] != "run" else ["--no-pictures"]
    return CliRunner().invoke(app, [str(argument) for argument in (*arguments, *pictures)])


def resume(*arguments):
    return invoke("run", "--resume", "half", "--out", "rest", *arguments)


def difference(first, second):
    fields = [field.name for field in dataclasses.fields(first)]
    return {name: float((getattr(first, name).double() - getattr(second, name).double()).abs().max()) for name in fields}


def test_a_resumed_run_equals_a_straight_one(directory, half):
    assert invoke("run", "shift.yaml", *PARTS, "--stages", 2, "--seed", 5, "--out", "whole").exit_code == 0
    finished = resume("--stages", 1, "--json")
    assert finished.exit_code == 0, finished.output
    assert json.loads(finished.stdout)["resumed_from"] == "half"
    whole, rest = load_record("whole"), load_record("rest")
    assert [stage.index for stage in rest.stages] == [1]
    assert set(difference(whole.state, rest.state).values()) == {0.0}
    assert rest.run["loss_final"] == whole.run["loss_final"]
    assert rest.run["metric_value"] == whole.run["metric_value"]
    assert torch.equal(whole.stages[1].actions, rest.stages[0].actions)
    assert {line["stage"] for line in rest.metrics} == {1}


def test_the_record_says_where_it_came_from(half):
    assert load_record("half").run["resumed_from"] is None
    assert resume("--stages", 2, "--seed", 6).exit_code == 0
    record = load_record("rest")
    names = {"backend": "toy", "ot": "toy", "placer": "toy", "strategy": "cpdeform"}
    assert record.run["resumed_from"] == {"directory": "half", "status": "finished", "stages": 1, "names": names}
    configuration = record.run["configuration"]
    assert (configuration["task"], configuration["seed"], configuration["optimizer"]["iterations"]) == ("shift.yaml", 6, 3)
    assert [stage.index for stage in record.stages] == [1, 2]
    finished = invoke("run", "--resume", "rest", "--out", "more")
    assert finished.exit_code == 0
    assert "resumed  from rest, at stage 4" in finished.stdout
    assert [stage.index for stage in load_record("more").stages] == [3]


def test_stages_that_were_left(directory):
    assert invoke("run", "shift.yaml", *PARTS, "--stages", 3, "--out", "half").exit_code == 0
    for number in (1, 2):
        (directory / "half" / f"stage-00{number}.h5").unlink()
    assert resume().exit_code == 0
    assert [stage.index for stage in load_record("rest").stages] == [1, 2]


def test_task_and_goal_are_the_records(directory, half):
    (directory / "shift.yaml").unlink()
    (directory / "goal.npz").unlink()
    assert resume("--set", "scene.ground_friction=3").exit_code == 0
    record = load_record("rest")
    assert record.task.scene.ground_friction == 3.0
    assert torch.equal(record.goal, load_record("half").goal)
    shutil.rmtree(half)
    assert invoke("run", "--resume", "rest", "--out", "more").exit_code == 0
    assert load_record("more").task.scene == record.task.scene


def test_the_same_task_may_be_named(directory, half):
    assert invoke("run", "shift.yaml", "--resume", "half", "--out", "rest").exit_code == 0


def test_options_go_with_their_part(directory):
    options = ["--set", "simulator_options.delay=0.001", "--set", "placer_options.count=2"]
    assert invoke("run", "shift.yaml", *PARTS, "--stages", 1, "--out", "half", *options).exit_code == 0
    assert resume("--placer", "toy-fixed").exit_code == 0
    configuration = load_record("rest").run["configuration"]
    assert configuration["simulator_options"] == {"delay": 0.001}
    assert configuration["placer_options"] == {}


def test_a_run_made_in_python(directory):
    parts = {"simulator": "toy", "ot_solver": "toy", "placer": "toy", "strategy": "cpdeform"}
    result = deform("shift.yaml", **parts, optimizer=TrajectoryOptimizer(iterations=3), stages=1, seed=4)
    result.save("half")
    finished = resume("--iterations", 2)
    assert finished.exit_code == 0, finished.output
    assert load_record("rest").run["configuration"]["seed"] == 4
    assert load_record("rest").stages[0].index == 1


def test_parts_that_were_chosen_automatically_stay(half):
    run = json.loads((half / "run.json").read_text())
    run["configuration"]["backend"] = "auto"
    (half / "run.json").write_text(json.dumps(run))
    assert resume().exit_code == 0
    assert load_record("rest").run["names"]["backend"] == "toy"


def test_pictures_of_a_resumed_run(half):
    finished = CliRunner().invoke(app, ["run", "--resume", "half", "--out", "rest"])
    assert finished.exit_code == 0
    assert "picture  rest/picture.png" in finished.stdout


@pytest.mark.parametrize(
    ("arguments", "messages"),
    [
        (["writer"], ['TASK: got "writer-v1"', '"shift"', "Leave TASK out"]),
        (["changed.yaml"], ['"shift" with another scene, step_count, goal', "half"]),
        (["--set", "task=writer"], ['TASK: got "writer-v1"']),
        (["--set", "scene.bodies.0.particle_count=30"], ["state: got 60 particles, expected 30 particles"]),
        (["--set", "scene.grid_sise=32"], ['Did you mean "grid_size"']),
        (["--backend", "tyo"], ['Did you mean "toy"']),
        (["--stages", "0"], ["--stages: got 0"]),
        (["--resume", "shift.yaml"], ["run record shift.yaml", "no run.json"]),
        (["--resume", "empty"], ["no complete stage", "without --resume"]),
        (["--out", "half"], ["--out", "directory of --resume"]),
    ],
)
def test_unusable_options(directory, half, arguments, messages):
    task = yaml.safe_load((directory / "shift.yaml").read_text())
    task["scene"]["grid_size"], task["step_count"], task["goal"] = 32, 7, "other.npz"
    (directory / "changed.yaml").write_text(yaml.safe_dump(task))
    np.savez(directory / "other.npz", position=load_record("half").goal + 0.01)
    shutil.copytree(half, directory / "empty")
    (directory / "empty" / "stage-000.h5").unlink()
    finished = resume(*arguments)
    assert finished.exit_code == 2, finished.output
    assert len(finished.stderr.splitlines()) == 1
    for message in messages:
        assert message in finished.stderr
    assert not (directory / "rest").exists()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("first", "second"), [("warp", "warp"), ("warp", "example"), ("example", "warp"), ("warp", "taichi"), ("taichi", "warp")]
)
def test_runs_go_on_on_another_backend(first, second, tmp_path, monkeypatch):
    missing = {first, second} - set(load_registry().names("simulator"))
    if missing:
        pytest.skip(f"not installed: {', '.join(missing)}")
    monkeypatch.chdir(tmp_path)
    simulator = SimulatorWarp(Scene.model_validate(BOARD))
    pressing = torch.tensor([0.0, -1.0, 0.0]).expand(1, 8, 3)
    np.savez("goal.npz", position=simulator.rollout(simulator.initial_state(), pressing).positions[0, -1])
    content = {"name": "board", "scene": BOARD, "goal": "goal.npz", "step_count": 4, "stage_count": 2}
    (tmp_path / "board.yaml").write_text(yaml.safe_dump(content))
    options = ["--placer", "fixed", "--iterations", "2", "--set", "objective.points=100", "--set", "optimizer.learning_rate=0.3"]
    for backend, stages, out in ((second, 2, "whole"), (first, 1, "half")):
        finished = invoke("run", "board.yaml", "--backend", backend, "--stages", stages, *options, "--out", out)
        assert finished.exit_code == 0, finished.output
    finished = resume("--backend", second)
    assert finished.exit_code == 0, finished.output
    whole, rest = load_record("whole"), load_record("rest")
    assert rest.run["names"]["backend"] == second
    assert [stage.index for stage in rest.stages] == [1]
    found = difference(whole.state, rest.state)
    # the same numbers but for rounding: one of the halves may have been computed in single precision
    exact = first == second
    assert found["position"] <= (0.0 if exact else 1e-5), found
    assert found["tool_pose"] <= (0.0 if exact else 1e-4), found
    assert float((whole.state.position - load_record("half").state.position).abs().max()) > 1e-3
    assert rest.run["loss_final"] == pytest.approx(whole.run["loss_final"], rel=1e-3)
