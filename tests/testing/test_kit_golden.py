"""`check_golden_file` and `cpdeform check` on the command line."""

from __future__ import annotations

import copy
import dataclasses
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from kit import changed_final, changed_gradient, changed_scene, scaled_gradient
from typer.testing import CliRunner

from cpdeform.backends.warp.simulator import SimulatorWarp
from cpdeform.cli.main import app
from cpdeform.core.simulator import Simulator
from cpdeform.core.state import initial_state
from cpdeform.testing import check_golden_file

SCENE = {
    "bodies": [{"kind": "box", "position": [0.5, 0.06, 0.5], "widths": [0.1, 0.1, 0.1], "particle_count": 200}],
    "tools": [{"kind": "Sphere", "radius": 0.03, "position": [0.5, 0.14, 0.5], "action_scale": [0.01, 0.01, 0.01]}],
}


@pytest.fixture
def recorded(tmp_path: Path) -> Path:
    """A folder of golden files that hold what the Warp backend does: a torus, and a pinch with an unknown tool."""
    from cpdeform.core.scene import Scene
    from cpdeform.planning.objectives.plasticinelab import ObjectivePlasticineLab, mass_grid

    scene = Scene.model_validate({**SCENE, "grid_size": 32, "substeps": 4})
    simulator = SimulatorWarp(scene, dtype=torch.float64)
    state = initial_state(scene, dtype=torch.float64)
    actions = -torch.ones(1, 3, 3, dtype=torch.float64)
    trajectory = simulator.rollout(state, actions)
    grid = mass_grid(state.position[0] + torch.tensor([0.05, 0.0, 0.0]), scene)
    result = ObjectivePlasticineLab(scene, grid).evaluate(trajectory)
    gradient = simulator.vjp(trajectory, result.grad_positions, result.grad_tools).actions[0].numpy().copy()
    gradient[:, 0] = 1e299
    zeros, identity = np.zeros((200, 3, 3)), np.tile(np.eye(3), (200, 1, 1))
    (tmp_path / "golden").mkdir()
    (tmp_path / "plasticinelab").mkdir()
    for name in ("torus-v2-seed0", "pinch-v1"):
        np.savez(
            tmp_path / "golden" / f"{name}.npz",
            x0=state.position[0], v0=state.velocity[0], C0=zeros, F0=identity, prim=trajectory.tool_poses[0, :, 0, :7],
            actions=actions[0], x=trajectory.positions[0, -1], v=trajectory.final_state.velocity[0], grad=gradient,
            total_loss=float(result.loss[0]), softness=666.0, n_grid=32, substeps=4, dt=1e-4,
        )  # fmt: skip
    unknown = copy.deepcopy(SCENE)
    unknown["tools"][0]["kind"] = "Spoon"
    content = {"torus": {**SCENE, "variants": []}, "pinch": unknown}
    (tmp_path / "plasticinelab" / "scenes.json").write_text(json.dumps(content))
    cells = torch.nonzero(grid)
    counts = grid[tuple(cells.T)] / scene.particle_volume
    np.savez(tmp_path / "plasticinelab" / "target_grids.npz", **{"Torus3D-v2/cells": cells, "Torus3D-v2/count": counts})
    return tmp_path / "golden"


def test_golden_files_of_the_same_backend_agree(recorded):
    errors = check_golden_file(recorded / "torus-v2-seed0.npz", SimulatorWarp)
    assert errors.status == "passed", str(errors)
    assert errors.position_error < 1e-6
    assert errors.pose_error < 1e-6
    assert errors.gradient_cosine > 0.99999
    assert errors.gradient_norm_error < 1e-3
    assert errors.loss_error < 1e-4


@pytest.mark.parametrize(
    ("simulator", "words"),
    [
        (changed_scene(gravity_scale=3000.0), "velocity error"),
        (scaled_gradient("actions", 1.05), "gradient norm"),
        (changed_gradient(lambda gradient, _: dataclasses.replace(gradient, actions=gradient.actions.flip(2))), "gradient"),
        (changed_gradient(lambda gradient, _: dataclasses.replace(gradient, actions=gradient.actions * torch.nan)), "cosine"),
        (changed_final(lambda final: 1 / 0), "ZeroDivisionError"),
    ],
)
def test_golden_files_catch_broken_simulators(recorded, simulator, words):
    errors = check_golden_file(recorded / "torus-v2-seed0.npz", simulator)
    assert errors.status == "failed"
    assert words in errors.reason


def test_golden_on_the_command_line(recorded):
    arguments = ["check", "golden", str(recorded), "--backend", "warp"]
    finished = CliRunner().invoke(app, [*arguments, "--json"])
    assert finished.exit_code == 1
    lines = [json.loads(line) for line in finished.stdout.splitlines()]
    assert [(line["name"], line["status"]) for line in lines[:-1]] == [("pinch-v1", "unsupported"), ("torus-v2-seed0", "passed")]
    assert "Spoon" in lines[0]["reason"]
    assert lines[-1] == {"backend": "warp", "passed": False, "files": lines[:-1]}
    finished = CliRunner().invoke(app, [*arguments, "--allow-unsupported"])
    assert finished.exit_code == 0
    assert "torus-v2-seed0" in finished.stdout


def test_golden_page(recorded, tmp_path):
    arguments = ["check", "golden", str(recorded), "--backend", "warp", "--backend", "example", "--allow-unsupported"]
    page = tmp_path / "golden.md"
    finished = CliRunner().invoke(app, [*arguments, "--markdown", str(page), "--json"])
    content = json.loads(finished.stdout.splitlines()[-1])
    assert (content["backend"], len(content["files"])) == ("warp,example", 4)
    text = page.read_text()
    rows = [line.split(" | ") for line in text.splitlines() if line.startswith(("| torus", "| pinch"))]
    assert [(row[0], row[1], row[-1]) for row in rows] == [
        ("| pinch-v1", "example", "unsupported |"),
        ("| pinch-v1", "warp", "unsupported |"),
        ("| torus-v2-seed0", "example", "passed |"),
        ("| torus-v2-seed0", "warp", "passed |"),
    ]
    assert rows[0][2:7] == ["-"] * 5
    assert float(rows[3][2]) < 1e-6
    command = "cpdeform check golden GOLDEN_DIR --backend warp --backend example --markdown golden.md"
    for words in (command, "cpdeform 0.", "Spoon", "0.0001"):
        assert words in text
    assert str(tmp_path) not in text
    finished = CliRunner().invoke(app, [*arguments, "--markdown", str(tmp_path / "absent" / "golden.md")])
    assert finished.exit_code == 2
    assert "--markdown" in finished.stderr


def test_golden_needs_files(tmp_path):
    finished = CliRunner().invoke(app, ["check", "golden", str(tmp_path)])
    assert finished.exit_code == 2
    assert "golden files" in finished.stderr
    np.savez(tmp_path / "teapot-v1.npz", x=np.zeros(3))
    finished = CliRunner().invoke(app, ["check", "golden", str(tmp_path)])
    assert finished.exit_code == 1
    assert "teapot-v1" in finished.stdout


@pytest.mark.parametrize(
    ("arguments", "subject"),
    [
        (["simulator", "warp", "--only", "bad arguments"], "SimulatorWarp"),
        (["ot_solver", "geomloss", "--only", "gauge"], "OTSolverGeomLoss"),
        (["placer", "fixed"], "PlacerFixed"),
    ],
)
def test_parts_on_the_command_line(arguments, subject):
    finished = CliRunner().invoke(app, ["check", *arguments])
    assert finished.exit_code == 0
    assert finished.stdout.startswith(subject)
    finished = CliRunner().invoke(app, ["check", *arguments, "--json"])
    content = json.loads(finished.stdout)
    assert content["passed"]
    assert content["subject"] == subject


def test_a_failed_check_is_exit_code_1():
    arguments = ["check", "ot_solver", "geomloss", "--set", "settings=paper", "--only", "gradient"]
    finished = CliRunner().invoke(app, arguments)
    assert finished.exit_code == 1
    assert "failed" in finished.stdout


def test_unknown_names_are_exit_code_2():
    finished = CliRunner().invoke(app, ["check", "simulator", "wrap"])
    assert finished.exit_code == 2
    assert 'Did you mean "warp"?' in finished.stderr


def test_help_imports_nothing_heavy():
    script = (
        "import sys\nfrom cpdeform.cli.main import app\n"
        "try:\n    app(['check', 'golden', '--help'])\nexcept SystemExit:\n    pass\n"
        "print('\\nHEAVY', sorted({'torch', 'warp', 'ot', 'h5py', 'scipy', 'numpy'} & set(sys.modules)))\n"
    )
    finished = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert finished.stdout.splitlines()[-1] == "HEAVY []"


def test_simulator_stays_an_interface():
    assert Simulator.__abstractmethods__ == {"rollout", "vjp", "memory_estimate"}
