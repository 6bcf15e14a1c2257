"""The whole method on a small board: a pen finds where to press, from the command line and in Python."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from typer.testing import CliRunner

from cpdeform import Scene, TrajectoryOptimizer, deform, load_task
from cpdeform.backends.warp.simulator import SimulatorWarp
from cpdeform.cli.main import app
from cpdeform.core.goal import write_goal
from cpdeform.ot.geomloss import OTSolverGeomLoss
from cpdeform.ot.pot import OTSolverPOT
from cpdeform.planning.result import Status
from cpdeform.run.record import load_record
from cpdeform.tasks.scripts import Leg, perform

README = Path(__file__).resolve().parents[1] / "README.md"
SCENE: dict[str, Any] = {
    "bodies": [{"kind": "box", "position": [0.5, 0.08, 0.5], "widths": [0.4, 0.16, 0.4], "particle_count": 1200}],
    "tools": [
        {
            "kind": "Capsule",
            "radius": 0.06,
            "height": 0.1,
            "position": [0.5, 0.275, 0.5],
            "friction": 0.0,
            "lower_bound": [0.0, 0.1, 0.0],
            "action_scale": [0.02, 0.02, 0.02],
        }
    ],
    "ground_friction": 100.0,
    "grid_size": 32,
}
STROKE = (Leg(3, {0: (0.0, -1.0, 0.0)}, {0: (0.38, 0.271, 0.62)}), Leg(2, {0: (0.5, -0.3, -0.5)}))


@pytest.fixture(scope="module")
def board(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Task file of a small board with a stroke away from the pen's start."""
    folder = tmp_path_factory.mktemp("board")
    write_goal(folder / "goal.npz", perform(STROKE, SimulatorWarp(Scene.model_validate(SCENE), dtype=torch.float64)))
    path = folder / "board.yaml"
    content = {"name": "board", "scene": SCENE, "goal": "goal.npz", "step_count": 5, "metric": "incremental_iou"}
    path.write_text(yaml.safe_dump(content))
    return path


@pytest.mark.slow
@pytest.mark.parametrize("ot", ["pot", "geomloss"])
@pytest.mark.parametrize("placer", ["transport", "random"])
def test_every_combination_runs_from_the_command_line(ot: str, placer: str, board: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    arguments = ["run", str(board), "--backend", "warp", "--ot", ot, "--placer", placer, "--iterations", "4", "--json"]
    result = CliRunner().invoke(app, [*arguments, "--set", "objective.points=600", "--no-pictures", "--out", str(out)])
    assert result.exit_code in (0, 1), result.output
    summary = json.loads(result.stdout.splitlines()[-1])
    expected = {"task": "board", "backend": "warp", "ot": ot, "placer": placer, "seed": 0, "gradient_evaluations": 4}
    assert {key: summary[key] for key in expected} == expected
    record = load_record(out)
    assert record.status == summary["status"]
    # Only a plan that lowers the loss is executed, and then the run has finished.
    assert result.exit_code == (0 if summary["status"] == "finished" else 1)
    moved = float((record.state.position - record.stages[0].state_before.position).abs().max())
    if summary["status"] == "finished":
        assert summary["loss_final"] < summary["loss_initial"]
        assert moved > 1e-5
    else:
        assert summary["loss_final"] == summary["loss_initial"]
        assert moved == 0.0
    if placer == "transport":
        assert summary["status"] == "finished"
        assert summary["loss_final"] < 0.95 * summary["loss_initial"]


@pytest.mark.slow
def test_transport_beats_a_pen_that_stays(board: Path) -> None:
    task = load_task(board)
    losses = {}
    for placer in ("transport", "fixed"):
        result = deform(task, placer=placer, optimizer=TrajectoryOptimizer(iterations=12), seed=0)
        losses[placer] = result.loss_final / result.loss_initial
        assert result.gradient_evaluations == 12
        if placer == "transport":
            assert result.status is Status.FINISHED
            assert result.metric_value > 0.0
    assert losses["transport"] < 0.7
    assert losses["transport"] < losses["fixed"]


@pytest.mark.slow
def test_the_pen_is_put_over_the_stroke(board: Path) -> None:
    task = load_task(board)
    result = deform(task, optimizer=TrajectoryOptimizer(iterations=1))
    stage = result.stages[0]
    placed = stage.candidates[0].proposal.pose[0, :3]
    assert float((placed - torch.tensor(STROKE[0].start[0]))[[0, 2]].norm()) < 0.08
    # the stroke's far side keeps a priority near zero
    far = (stage.state_before.position[0] - torch.tensor([0.62, 0.08, 0.38])).norm(dim=-1) < 0.1
    assert stage.priorities[far].abs().mean() < 0.1 * stage.priorities.max()


@pytest.mark.slow
def test_solvers_agree_on_the_priorities(board: Path) -> None:
    task = load_task(board)
    source = SimulatorWarp(task.scene).initial_state().position[0]
    goal = torch.as_tensor(task.load_goal()).float()
    first, second = OTSolverPOT(blur=5e-3), OTSolverGeomLoss(blur=5e-3)
    one, other = first.solve(source, goal).source_potential, second.solve(source, goal).source_potential
    tolerance = first.capabilities.potential_tolerance + second.capabilities.potential_tolerance
    assert (one - other).abs().max() <= tolerance * (other.max() - other.min())
    assert int(one.argmax()) == int(other.argmax())


@pytest.mark.slow
def test_seeds_repeat_a_run(board: Path) -> None:
    task = load_task(board)
    runs = [deform(task, placer="random", optimizer=TrajectoryOptimizer(iterations=2), seed=seed) for seed in (3, 3, 4)]
    poses = [run.stages[0].candidates[0].proposal.pose for run in runs]
    assert torch.equal(poses[0], poses[1])
    assert not torch.equal(poses[0], poses[2])


@pytest.mark.slow
def test_the_readme_composes_a_run_in_under_ten_lines(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    block = re.search(r"```python\n(.*?)```", README.read_text(), re.DOTALL)
    assert block is not None
    code = block.group(1)
    assert len([line for line in code.splitlines() if line.strip()]) < 10
    assert "iterations=30" in code
    monkeypatch.chdir(tmp_path)
    scope: dict[str, Any] = {}
    exec(compile(code.replace("iterations=30", "iterations=2"), "README.md", "exec"), scope)
    assert scope["result"].gradient_evaluations == 2
    assert load_record(tmp_path / "runs" / "writer-v2").status == "finished"
