from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from golden import SHARED
from typer.testing import CliRunner

from cpdeform.cli.main import app
from cpdeform.core.goal import load_goal, load_goal_grid
from cpdeform.core.task import load_task
from cpdeform.planning.objectives.mass import mass_grid
from cpdeform.tasks.grid_import import PLASTICINELAB_NAMES, goal_name, import_grids, task_name

COUNT = 800


@pytest.fixture
def directory(tmp_path, monkeypatch, make_toy_task, toy_distribution):
    """The current directory, with a task of 800 particles in it and the toy parts installed."""
    monkeypatch.syspath_prepend(str(toy_distribution))
    monkeypatch.chdir(tmp_path)
    body = {"kind": "sphere", "position": [0.4, 0.4, 0.4], "radius": 0.1, "particle_count": COUNT}
    tool = {"kind": "Sphere", "radius": 0.05, "position": [0.4, 0.7, 0.4], "action_scale": [0.02, 0.02, 0.02]}
    make_toy_task(scene={"bodies": [body], "tools": [tool]})
    return tmp_path


@pytest.fixture
def grid(directory):
    """Node masses, in particle masses, of 1000 particles: a ball and a slab on the floor."""
    generator = np.random.default_rng(0)
    ball = generator.standard_normal((500, 3))
    ball = 0.5 + 0.06 * ball / np.linalg.norm(ball, axis=1, keepdims=True) * generator.uniform(0, 1, (500, 1)) ** (1 / 3)
    slab = generator.uniform([0.2, 0.0, 0.2], [0.3, 0.04, 0.3], (500, 3))
    scene = load_task("shift.yaml").scene
    return mass_grid(torch.as_tensor(np.concatenate([ball, slab])), scene).numpy() / scene.particle_volume


def sparse(**grids):
    arrays = {}
    for name, values in grids.items():
        cells = np.argwhere(values != 0)
        arrays |= {f"{name}/cells": cells.astype(np.uint8), f"{name}/count": values[tuple(cells.T)].astype(np.float32)}
    return arrays


def invoke(*arguments):
    return CliRunner().invoke(app, ["task", "import-grid", *(str(argument) for argument in arguments)])


def test_particles_have_the_masses_of_the_grid(directory, grid):
    scene = load_task("shift.yaml").scene
    np.save("grid.npy", grid.astype(np.float32))
    result = invoke("grid.npy", "--task", "shift.yaml", "--out", "goals/goal.npz")
    assert result.exit_code == 0, result.output
    assert "goals/goal.npz: grid for shift, 800 particles, error of the node masses" in result.stdout
    assert "--set scene.sampling=plasticinelab" in result.stdout
    # The slab lies on a floor that the ball of clay begins high above.
    assert "warning: goal below the floor: goal: " in result.stdout
    goal = directory / "goals" / "goal.npz"
    position, kept = load_goal(goal, scene=scene), load_goal_grid(goal, scene=scene)
    assert position.shape == (COUNT, 3)
    assert kept.sum() == pytest.approx(COUNT * scene.particle_volume, rel=1e-5)
    np.testing.assert_allclose(kept, grid * scene.particle_volume * COUNT / grid.sum(), rtol=1e-5, atol=1e-12)
    masses = mass_grid(torch.as_tensor(position), scene).numpy()
    assert np.abs(masses - kept).sum() / kept.sum() < 0.01
    # as even as a cloud of this density can be: no two particles lie on one another
    distance = torch.pdist(torch.as_tensor(position)).min()
    assert distance > 0.1 / 64
    first = goal.read_bytes()
    assert invoke("grid.npy", "--task", "shift.yaml", "--out", goal, "--overwrite").exit_code == 0
    assert goal.read_bytes() == first


def test_run_takes_the_goal_and_evaluate_its_grid(directory, grid):
    np.savez("grids.npz", **sparse(one=grid, two=grid[::-1].copy()))
    result = invoke("grids.npz", "--name", "one", "--task", "shift.yaml", "--particles", 300, "--out", "imported.npz")
    assert result.exit_code == 0, result.output
    parts = ["--backend", "toy", "--ot", "toy", "--placer", "toy", "--iterations", "2", "--stages", "1", "--no-pictures"]
    run = CliRunner().invoke(app, ["run", "shift.yaml", *parts, "--goal", "imported.npz", "--out", "run", "--json"])
    assert run.exit_code == 0, run.output
    summary = json.loads(run.stdout)
    assert summary["metric_initial"] > 0.0
    for flags in ([], ["--exact"], ["--paper", "--paper-blur", "0.01"]):
        found = CliRunner().invoke(app, ["evaluate", "run", "--json", "--no-rest", *flags])
        assert found.exit_code == 0, found.output
        figures = json.loads(found.stdout)
        assert (figures["grid"], figures["particle_count"], figures["goal_count"]) == ("file", COUNT, 300)
        assert figures["wasserstein_final"] == pytest.approx(summary["metric_value"], rel=1e-3)
        assert (figures["exact_final"] is None) == ("--exact" not in flags)
        assert figures["paper_blur"] == (0.01 if "--paper" in flags else None)
    text = CliRunner().invoke(app, ["evaluate", "run", "--no-rest"]).stdout
    for part in ("incremental IoU", "Wasserstein-1", "floor", "node masses from its file"):
        assert part in text
    assert CliRunner().invoke(app, ["evaluate", "run", "--paper-blur", "0"]).exit_code == 2
    assert CliRunner().invoke(app, ["evaluate", "nothing"]).exit_code == 2


def test_names(directory, grid):
    np.savez("dense.npz", **{"Writer3D-v1": grid, "Move3D-v2": grid, "other": np.zeros(3)})
    common = ("--task", "shift.yaml", "--out", "imported.npz", "--particles", 5)
    several = invoke("dense.npz", *common)
    assert several.exit_code == 2
    assert "--name: got none, expected one of the 2 grids in dense.npz: Move3D-v2, Writer3D-v1" in several.stderr
    unknown = invoke("dense.npz", *common, "--name", "Writer3D-v")
    assert unknown.exit_code == 2
    assert 'Did you mean "Writer3D-v1"?' in unknown.stderr
    assert invoke("dense.npz", *common, "--name", "Writer3D-v1").exit_code == 0
    np.savez("single.npz", grid=grid)
    refused = invoke("single.npz", "--out", "other.npz")
    assert refused.exit_code == 2
    assert "--task: got none" in refused.stderr
    assert invoke("single.npz", *common, "--overwrite").exit_code == 0
    names = {"Move3D-v3": "move-v3", "multistage_rope-v1": "rope++", "Rollingpin3D-v1": "rolling-pin-v1", "vase-v1": None}
    assert {name: task_name(name) for name in names} == names
    assert {goal_name(f"Pinch3D-v{variant}") for variant in (1, 2, 3)} == {"pinch-v1", "pinch-v2", "pinch-v3"}


@pytest.mark.parametrize("name", PLASTICINELAB_NAMES)
def test_every_name_of_plasticinelab_has_a_task(name):
    assert load_task(task_name(f"{name}-v1")).name in {task_name(f"{name}-v1"), task_name(name)}


@pytest.mark.filterwarnings("always::UserWarning")
def test_negative_masses_that_are_rounding_count_as_none(directory, grid):
    """Masses of -2.6e-5 beside a largest of 1.1e-3, as in one of the grids that PlasticineLab published."""
    grid *= 1.1e-3 / grid.max()
    empty = np.argwhere(grid == 0.0)[:20]
    noisy = grid.copy()
    noisy[tuple(empty.T)] = -2.6e-5
    np.save("noisy.npy", noisy)
    result = invoke("noisy.npy", "--task", "shift.yaml", "--particles", 50, "--out", "noisy.npz")
    assert result.exit_code == 0, result.output
    assert "20 negative masses" in result.stderr
    kept = load_goal_grid(directory / "noisy.npz", scene=load_task("shift.yaml").scene)
    assert (kept[tuple(empty.T)] == 0.0).all()
    assert kept[grid > 0.0].min() > 0.0
    for share, name in ((0.06, "deep"), (0.04, "many")):
        bad = grid.copy()
        bad[tuple((empty[:1] if name == "deep" else np.argwhere(grid == 0.0)[:5000]).T)] = -share * grid.max()
        np.save(f"{name}.npy", bad)
        result = invoke(f"{name}.npy", "--task", "shift.yaml", "--out", f"{name}.npz")
        assert result.exit_code == 2
        assert "negative masses" in result.stderr


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "no such file"),
        (b"text", "unreadable"),
        ({"a": np.zeros((4, 3))}, r"expected node masses"),
        ({"a": np.zeros((32, 32, 32))}, "shape (32, 32, 32)"),
        ({"a": np.zeros((64, 64, 64))}, "no masses"),
        ({"a": np.full((64, 64, 64), np.nan)}, "non-finite"),
        ({"a": np.full((64, 64, 64), -1.0)}, "negative"),
        ({"a/cells": np.array([[1, 2, 64]]), "a/count": np.ones(1)}, "a node index 64"),
        ({"a/cells": np.array([[1, 2, 3]]), "a/count": np.ones(2)}, "expected node indices of shape (2, 3)"),
    ],
)
def test_bad_grids(directory, content, message):
    path = directory / "bad.npz"
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif content is not None:
        np.savez(path, **content)
    result = invoke(path, "--task", "shift.yaml", "--out", "imported.npz")
    assert result.exit_code == 2, result.output
    assert message in result.stderr
    assert not (directory / "imported.npz").exists()


def test_bad_options(directory, grid):
    np.save("grid.npy", grid)
    good = {"--task": "shift.yaml", "--out": "imported.npz"}
    cases = (
        ({"--particles": 0}, "at least 1"),
        ({"--seed": -1}, "--seed"),
        ({"--task": "wrtier"}, 'Did you mean "writer"'),
        ({"--out": "goal.npz"}, "Replace it with --overwrite"),
        ({"--out": "goal.txt"}, "ends in .npz"),
        ({"--out": "shift.yaml/goal.npz"}, "cannot be written"),
        ({"--all": None}, "nothing with --all"),
    )
    for changes, message in cases:
        flags = [str(part) for pair in (good | changes).items() for part in pair if part is not None]
        result = invoke(
            "grid.npy", *flags, *(["--particles", 5] if "--particles" not in changes and "--all" not in changes else [])
        )
        assert result.exit_code == 2, (changes, result.output)
        assert message in result.stderr


def test_all_grids_of_an_archive(directory, grid, monkeypatch):
    small = load_task("shift.yaml")
    small = small.model_copy(
        update={
            "scene": small.scene.model_copy(update={"bodies": (small.scene.bodies[0].model_copy(update={"particle_count": 40}),)})
        }
    )
    asked = []
    monkeypatch.setattr("cpdeform.tasks.grid_import.load_task", lambda name, registry: asked.append(name) or small)
    np.savez("grids.npz", **sparse(**{"Writer3D-v2": grid, "multistage_move-v1": grid, "vase": grid}))
    result = invoke("grids.npz", "--all", "--out", "goals")
    assert result.exit_code == 0, result.output
    assert asked == ["writer-v2", "move++"]
    assert sorted(path.name for path in (directory / "goals").iterdir()) == ["move++.npz", "writer-v2.npz"]
    assert invoke("grids.npz", "--all", "--out", "goals").exit_code == 2
    results = import_grids(directory / "grids.npz", directory / "more", ["Writer3D-v2"])
    assert [item.path for item in results] == [directory / "more" / "writer-v2.npz"]
    np.savez("others.npz", vase=grid)
    assert "PlasticineLab's scenes" in invoke("others.npz", "--all", "--out", "goals").stderr


def test_a_grid_of_plasticinelab(directory):
    path = SHARED / "plasticinelab" / "target_grids.npz"
    if not path.exists():
        pytest.skip(f"no {path}; set CPDEFORM_SHARED to the folder that holds plasticinelab/")
    result = invoke(path, "--name", "Writer3D-v1", "--particles", 3000, "--out", "imported.npz")
    assert result.exit_code == 0, result.output
    scene = load_task("writer-v1").scene
    masses = mass_grid(torch.as_tensor(load_goal(directory / "imported.npz", scene=scene)), scene).numpy()
    kept = load_goal_grid(directory / "imported.npz", scene=scene)
    assert kept.sum() == pytest.approx(3000 * scene.particle_volume, rel=1e-5)
    assert np.abs(masses - kept).sum() / kept.sum() < 0.02
