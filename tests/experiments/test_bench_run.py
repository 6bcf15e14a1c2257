"""`cpdeform bench run`."""

from __future__ import annotations

import json
import os

import pytest
from toy_fixtures import TOYS
from typer.testing import CliRunner

from cpdeform.cli.main import app
from cpdeform.experiments.bench_run import MEASURED

COLUMNS = {"task", "backend", "solver", "device", "threads", "seed", "error", *MEASURED}


@pytest.fixture
def toys(monkeypatch, toy_distribution):
    """The toy parts, installed here and in the workers."""
    monkeypatch.syspath_prepend(str(toy_distribution))
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(TOYS), str(toy_distribution)]))


def bench(*arguments):
    return CliRunner().invoke(app, ["bench", "run", *(str(argument) for argument in arguments)])


def run_toy(toy_task_file, *arguments):
    return bench(toy_task_file, "--backends", "toy", "--solvers", "toy", "--iterations", "3", "--threads", "1", *arguments)


def test_rows_as_json(toys, toy_task_file):
    finished = run_toy(toy_task_file, "--seeds", "0,1", "--stages", "1", "--json")
    assert finished.exit_code == 0, finished.output
    content = json.loads(finished.stdout.splitlines()[-1])
    assert set(content) == {"rows", "machine", "versions", "settings"}
    assert [row["seed"] for row in content["rows"]] == [0, 1]
    for row in content["rows"]:
        assert set(row) == COLUMNS
        assert row["error"] is None
        assert row["loss_ratio"] == pytest.approx(row["loss_final"] / row["loss_initial"])
        assert row["loss_final"] < row["loss_initial"]
        assert row["gradient_evaluations"] >= 3
        parts = sum(row[f"{part}_seconds"] for part in ("transport", "placement", "optimization", "execution"))
        assert parts <= row["seconds"]
        iterations = sum(row[f"{part}_ms_per_iteration"] for part in ("rollout", "objective", "vjp", "optimizer"))
        assert 0 < 1e-3 * iterations * 3 <= row["optimization_seconds"]


def test_table_and_what_cannot_run(toys, toy_task_file):
    finished = run_toy(toy_task_file)
    assert finished.exit_code == 0, finished.output
    assert "evaluations" in finished.stdout
    assert "toy, toy, threads 1, seed 0" in finished.stderr
    finished = run_toy(toy_task_file, "--timeout", "0.01", "--json")
    assert finished.exit_code == 1
    assert json.loads(finished.stdout)["rows"][0]["error"] == "timeout"


@pytest.mark.parametrize(
    ("arguments", "messages"),
    [
        (["writter"], ['"writter"', 'Did you mean "writer"']),
        (["writer", "--backends", "wrap"], ['simulator: got "wrap"', 'Did you mean "warp"']),
        (["writer", "--solvers", "gemloss"], ['ot_solver: got "gemloss"', 'Did you mean "geomloss"']),
        (["writer", "--seeds", "one"], ["--seeds", "whole numbers"]),
        (["writer", "--iterations", "0"], ["--iterations: got 0"]),
    ],
)
def test_unusable_options(arguments, messages):
    finished = bench(*arguments)
    assert finished.exit_code == 2, finished.output
    for message in messages:
        assert message in finished.stderr
