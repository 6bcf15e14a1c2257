"""What a record says, and whether it holds."""

from __future__ import annotations

import json

import h5py
import pytest
from typer.testing import CliRunner

from cpdeform.cli.main import app
from cpdeform.run.record_files import RUN_FILE, stage_file

PARTS = ["--backend", "toy", "--ot", "toy", "--placer", "toy", "--iterations", "3", "--no-pictures", "--quiet"]


@pytest.fixture
def directory(tmp_path, monkeypatch, toy_distribution, toy_task_file):
    """The current directory, with a record of two stages in it and the toy parts installed."""
    monkeypatch.syspath_prepend(str(toy_distribution))
    monkeypatch.chdir(tmp_path)
    assert invoke("run", "shift.yaml", *PARTS, "--seed", 5, "--out", "run").exit_code == 0
    return tmp_path / "run"


def invoke(*arguments):
    return CliRunner().invoke(app, [str(argument) for argument in arguments], env={"COLUMNS": "200"})


def test_config_with_origins_and_command(directory):
    lines = {line.split()[0]: line.split() for line in invoke("config", "run", "--origin").stdout.splitlines()}
    assert lines["seed"] == ["seed", "given", "5"]
    assert lines["device"] == ["device", "default", '"cpu"']
    rows = json.loads(invoke("config", "run", "--origin", "--json").stdout)
    assert rows["optimizer.iterations"] == {"value": 3, "origin": "given"}
    assert invoke("config", "run", "--command").stdout.startswith(
        "cpdeform run shift.yaml --backend toy --ot toy --placer toy --seed 5"
    )
    assert "seed: 5" in invoke("config", "run").stdout


def test_replay_of_the_same_simulator_gives_the_same_clay(directory):
    stages = json.loads(invoke("replay", "run", "--json").stdout)["stages"]
    assert [stage["stage"] for stage in stages] == [0, 1]
    assert max(stage["chained_largest"] for stage in stages) < 1e-6
    assert "stage 2: distance" in invoke("replay", "run").stdout


def test_verify_holds_for_a_record_as_it_was_made(directory):
    result = invoke("verify", "run")
    assert result.exit_code == 0, result.output
    assert "DIFFERS" not in result.stdout
    assert "stage 2: loss:" in result.stdout
    assert "wasserstein at the end" in result.stdout


def test_verify_finds_what_was_changed(directory):
    """A metric, a sum and a trajectory that somebody wrote over."""
    path = directory / RUN_FILE
    run = json.loads(path.read_text())
    path.write_text(json.dumps({**run, "metric_value": 0.5 * run["metric_value"], "gradient_evaluations": 1}))
    with h5py.File(directory / stage_file(1), "r+") as file:
        file["positions"][-1] += 0.05
    result = invoke("verify", "run", "--json")
    assert result.exit_code == 1
    wrong = {check["name"] for check in json.loads(result.stdout)["checks"] if not check["holds"]}
    assert wrong == {
        "wasserstein at the end",
        "gradient evaluations",
        "stage 2: mean distance of the replayed clay from the recorded one",
    }


@pytest.mark.parametrize("command", ["config", "replay", "verify", "draw", "report"])
def test_no_record(directory, command):
    result = invoke(command, "nowhere")
    assert result.exit_code == 2
    assert "no run.json" in result.stderr


def test_doctor_tells_what_auto_takes(directory):
    found = json.loads(invoke("doctor", "--json").stdout)
    names = {part["name"] for part in found["parts"]["simulator"]}
    assert "toy" in names
    assert found["auto"]["simulator"]["name"] in names
    text = invoke("doctor").stdout
    assert f"auto takes {found['auto']['simulator']['name']}" in text
    assert "compiler" in text


def test_completion_is_there(directory):
    assert "--show-completion" in invoke("--help").stdout
