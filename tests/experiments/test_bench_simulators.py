"""`cpdeform bench simulators`, and estimate and measurement of a simulator's memory."""

from __future__ import annotations

import json
import os

import pytest
import torch
from toy_fixtures import TOYS
from typer.testing import CliRunner

from cpdeform.cli.main import app
from cpdeform.core.errors import CpdeformError
from cpdeform.core.machine import available_cores
from cpdeform.core.plugins import load_registry
from cpdeform.experiments.bench_simulators import MEASURED, SLOW, default_backends
from cpdeform.experiments.simulator_measurement import board, wandering_actions
from cpdeform.experiments.worker import call_in_worker

COLUMNS = {"backend", "device", "threads", "particles", "worlds", "error", *MEASURED}
SIZES = {
    "50 steps": {"steps": 50, "particles": 10_000, "worlds": 1},
    "3 worlds": {"steps": 10, "particles": 10_000, "worlds": 3},
    "recomputed": {"steps": 50, "particles": 10_000, "worlds": 1, "options": {"memory_budget": 0}},
    "few particles": {"steps": 5, "particles": 1_000, "worlds": 1},
}
INSTALLED = [name for name in load_registry().names("simulator") if name not in SLOW]


@pytest.fixture
def toys(monkeypatch, toy_distribution):
    """The toy parts, installed here and in the workers."""
    monkeypatch.syspath_prepend(str(toy_distribution))
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(TOYS), str(toy_distribution)]))


def bench(*arguments):
    return CliRunner().invoke(app, ["bench", "simulators", *(str(argument) for argument in arguments)])


def test_rows_as_json(toys):
    sizes = ["--particles", "200000,100", "--worlds", "1,2", "--threads", "1", "--repeat", "1"]
    finished = bench("--backends", "toy,toy-missing", *sizes, "--json")
    assert finished.exit_code == 0, finished.output
    content = json.loads(finished.stdout.splitlines()[-1])
    assert set(content) == {"rows", "machine", "versions", "settings"}
    rows = content["rows"]
    assert all(set(row) == COLUMNS for row in rows)
    combinations = [(row["backend"], row["particles"], row["worlds"]) for row in rows]
    sizes = [(100, 1), (100, 2), (200_000, 1), (200_000, 2)]
    assert combinations == [(name, *size) for name in ("toy", "toy-missing") for size in sizes]
    for row in rows[:4]:
        assert row["error"] is None
        assert (row["dtype"], row["device"], row["threads"]) == ("float64", "cpu", 1)
        seconds = 1e-3 * (row["forward_ms_per_substep"] + row["backward_ms_per_substep"])
        assert row["particle_substeps_per_second"] == pytest.approx(row["particles"] * row["worlds"] / seconds)
        # At least the positions at the start and after both steps, in double precision; not all that the process holds.
        positions = 8e-6 * row["worlds"] * 3 * row["particles"] * 3
        assert positions < row["peak_memory_mb"] + 1.0 < 20.0 * positions + 30.0
        assert row["memory_estimate_mb"] == pytest.approx(8e-6 * row["worlds"] * 2 * row["particles"] * 3)
    for row in rows[4:]:
        assert 'pip install "cpdeform-toy[more]"' in row["error"]
        assert row["forward_ms_per_substep"] is None
    assert content["machine"]["cores"] == available_cores()
    assert content["versions"]["cpdeform-toy"] == "0.1"
    assert (content["settings"]["steps"], content["settings"]["backends"]) == (2, ["toy", "toy-missing"])


def test_table(toys):
    finished = bench("--backends", "toy,toy-missing", "--particles", "1000", "--worlds", "1", "--threads", "1", "--repeat", "1")
    assert finished.exit_code == 0, finished.output
    assert "particle substeps/s" in finished.stdout
    assert "1,000" in finished.stdout
    assert "toy-missing, particles 1,000, worlds 1, threads 1: " in finished.stdout
    assert "one substep of all worlds" in finished.stdout
    assert "torch" in finished.stdout.splitlines()[-1]
    assert "2/2" in finished.stderr


def test_nothing_that_runs_is_exit_code_1(toys):
    few = ["--particles", "100", "--worlds", "1", "--threads", "1"]
    assert bench("--backends", "toy-missing", *few).exit_code == 1
    finished = bench("--backends", "toy", *few, "--timeout", "0.01", "--json")
    assert finished.exit_code == 1
    assert json.loads(finished.stdout)["rows"][0]["error"] == "timeout"
    finished = bench("--backends", "toy", *few, "--device", "cuda", "--json")
    assert "runs on cpu, not on cuda" in json.loads(finished.stdout)["rows"][0]["error"]


@pytest.mark.parametrize(
    ("arguments", "messages"),
    [
        (["--backends", "wrap"], ['simulator: got "wrap"', 'Did you mean "warp"']),
        (["--backends", "warp,"], ["--backends", "separated by commas"]),
        (["--particles", "many"], ["--particles", "whole numbers"]),
        (["--particles", "0"], ["--particles: got 0"]),
        (["--worlds", "1,-2"], ["--worlds: got -2"]),
        (["--threads", "0"], ["--threads: got 0"]),
        (["--steps", "0"], ["--steps: got 0"]),
        (["--repeat", "0"], ["--repeat: got 0"]),
        (["--timeout", "0"], ["--timeout: got 0"]),
        (["--device", "gpu"], ['--device: got "gpu"']),
        (["--dtype", "float46"], ["--dtype", 'Did you mean "float64"']),
    ],
)
def test_unusable_options(arguments, messages):
    finished = bench(*([] if "--backends" in arguments else ["--backends", "warp"]), *arguments)
    assert finished.exit_code == 2, finished.output
    assert finished.stderr.count("cpdeform: error: ") == 1
    for message in messages:
        assert message in finished.stderr


def test_default_backends_are_installed_differentiable_and_not_slow(toys):
    names = default_backends(load_registry())
    assert {"toy", "warp"} <= set(names)
    assert not {"toy-missing", "example"} & set(names)


def test_the_pen_touches_the_board():
    simulator = load_registry().create("simulator", "warp", scene=board(500), batch_size=2)
    actions = wandering_actions(simulator, worlds=2, steps=6)
    assert bool((actions.abs() <= 1.0).all())
    assert not torch.equal(actions[0], actions[1])
    trajectory = simulator.rollout(simulator.initial_state(), actions)
    # lowest point of the pen, which is a capsule
    assert bool((trajectory.tool_poses[:, -1, 0, 1] - 0.06 < 0.09).all())


@pytest.mark.slow
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("backend", INSTALLED)
def test_memory_estimate_is_within_a_fifth_of_what_is_measured(backend, size):
    registry = load_registry()
    try:
        known = registry.option_names("simulator", backend)
    except CpdeformError as error:
        pytest.skip(str(error))
    wanted = SIZES[size]
    if known is not None and set(wanted.get("options", {})) - set(known):
        pytest.skip(f"{backend} has no option {', '.join(wanted['options'])}")
    request = {"backend": backend, "threads": 1, "repeat": 0, **wanted}

    def measured():
        return call_in_worker("cpdeform.experiments.simulator_measurement:measure", request, environment={"OMP_NUM_THREADS": "1"})

    found = measured()
    if found["memory_estimate_mb"] < 0.8 * found["rollout_memory_mb"]:
        # The whole process is measured: a just-in-time compiler that still works beside the rollout adds to it, now and then.
        found = measured()
    ratio = found["memory_estimate_mb"] / found["rollout_memory_mb"]
    assert 0.8 < ratio < 1.2, found
    if size == "50 steps":
        assert found["rollout_memory_mb"] < 1000.0
        assert found["peak_memory_mb"] < 1000.0
