"""Every example runs, with few particles, and does what it says."""

from __future__ import annotations

import importlib.util
import json
import re
import sys
from pathlib import Path
from types import ModuleType

import matplotlib as mpl
import pytest
import torch

from cpdeform import load_record
from cpdeform.planning.result import Status

EXAMPLES = Path(__file__).parent.parent / "examples"


def load(name: str) -> ModuleType:
    """The module of an example."""
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    # dataclasses look their module up
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture(autouse=True)
def _in_an_empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def test_first_run(capsys: pytest.CaptureFixture[str]) -> None:
    load("first_run").main(["--stages", "1", "--iterations", "6", "--particles", "400", "--out", "record"])
    printed = capsys.readouterr().out
    assert "stage 0, iteration 5" in printed
    assert load_record(Path("record")).state.particle_count == 400
    assert Path("record/after-stage-0.png").stat().st_size > 1000


def test_own_task_presses_a_wedge() -> None:
    example = load("own_task")
    scene = example.make_scene(400)
    result = example.plan(scene, mesh=None, folder=Path("task"), stages=1, iterations=6)
    assert result.task.name == "wedge"
    assert result.metric_value < result.metric_initial


def test_own_task_takes_a_mesh(capsys: pytest.CaptureFixture[str]) -> None:
    trimesh = pytest.importorskip("trimesh")
    trimesh.creation.box((3.0, 2.0, 2.0)).export("brick.stl")
    load("own_task").main(["--mesh", "brick.stl", "--particles", "300", "--stages", "1", "--iterations", "1"])
    assert "W1 to the goal" in capsys.readouterr().out


def test_own_parts_press_where_clay_is_too_high() -> None:
    result = load("own_parts").plan(iterations=4, stages=1, particles=1500)
    stage = result.stages[0]
    assert stage.candidates
    assert all(candidate.proposal.label.startswith("column") for candidate in stage.candidates)
    assert stage.status is Status.FINISHED
    assert stage.loss < stage.loss_before
    # the variations of the plan, and the execution
    assert stage.rollouts >= 5


def test_backends_agree_in_positions_and_gradients() -> None:
    backends = ["warp", "example"]
    outcomes = load("compare_backends").compare(backends, particles=100, steps=2)
    first, second = (outcomes[backend] for backend in backends)
    assert float((first.position - second.position).abs().max()) < 1e-9
    assert float(torch.cosine_similarity(first.gradient.flatten(), second.gradient.flatten(), dim=0)) > 1.0 - 1e-8


def test_a_sweep_compares_placers_and_goes_on(capsys: pytest.CaptureFixture[str]) -> None:
    example, arguments = load("sweep_of_placers"), ["--seeds", "1", "--iterations", "1", "--particles", "200", "--out", "sweep"]
    example.main(arguments)
    printed = capsys.readouterr().out
    assert printed.count(": done") == len(example.PLACERS)
    example.main(arguments)
    assert re.findall(r"mean .*", capsys.readouterr().out) == re.findall(r"mean .*", printed)


@pytest.mark.slow
def test_the_notebook_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    mpl.use("agg")
    notebook = json.loads((EXAMPLES / "first_steps.ipynb").read_text(encoding="utf-8"))
    scope: dict[str, object] = {"__name__": "notebook"}
    for cell in notebook["cells"]:
        source = "".join(cell["source"]).replace("PARTICLES, ITERATIONS = 2000, 10", "PARTICLES, ITERATIONS = 400, 2")
        if cell["cell_type"] == "code":
            assert cell["outputs"] == []
            exec(compile(source, cell["id"], "exec"), scope)
    assert Path("runs/first-steps/run.json").exists()
