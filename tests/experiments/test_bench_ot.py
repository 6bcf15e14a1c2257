"""`cpdeform bench ot`."""

from __future__ import annotations

import json
import time

import pytest
import torch
from typer.testing import CliRunner

from cpdeform.cli.main import app
from cpdeform.core.plugins import load_registry
from cpdeform.experiments import ot_measurement
from cpdeform.experiments.bench_ot import MEASURED, default_solvers
from cpdeform.experiments.ot_measurement import STEP, dented_board, smooth_motion
from cpdeform.ot.geomloss import OTSolverGeomLoss

COLUMNS = {"solver", "device", "blur", "threads", "points", "error", *MEASURED}


def bench(*arguments):
    return CliRunner().invoke(app, ["bench", "ot", *(str(argument) for argument in arguments)])


def test_rows_as_json():
    begin = time.perf_counter()
    finished = bench(
        "--solvers", "geomloss,pot", "--points", "120,100", "--threads", "1", "--steps", "2", "--blur", "3e-3", "--json"
    )
    seconds = time.perf_counter() - begin
    assert finished.exit_code == 0, finished.output
    content = json.loads(finished.stdout.splitlines()[-1])
    assert set(content) == {"rows", "machine", "versions", "settings"}
    rows = content["rows"]
    assert all(set(row) == COLUMNS for row in rows)
    assert [(row["solver"], row["points"]) for row in rows] == [(name, size) for name in ("geomloss", "pot") for size in (100, 120)]
    for row in rows:
        assert row["error"] is None
        assert row["converged"]
        # Every row is measured in a process of its own, which has to import torch first.
        assert 0.0 < row["cold_ms"] < 1e3 * seconds
        assert 0.0 < row["warm_ms"] < 1e3 * seconds
        assert row["cold_gradient_cosine"] > 0.99
        assert row["warm_gradient_cosine"] > 0.9
        assert abs(row["value_error_against_exact"]) < 0.2
        # A matrix of 120 x 120 numbers takes 0.1; all that the process holds is hundreds.
        assert row["peak_memory_mb"] < 50.0
    assert content["settings"]["blur"] == 3e-3


def test_peak_is_that_of_a_cold_solution(monkeypatch):
    class OTSolverHeavy(OTSolverGeomLoss):
        """Holds 64 MB during a solution of more than 100 points."""

        def solve(self, source, target, **options):
            held = torch.ones(64_000_000 if len(source) > 100 else 1, dtype=torch.uint8)
            result = super().solve(source, target, **options)
            assert held.all()
            return result

    original = ot_measurement._build

    def build(registry, name, *arguments, **options):
        return OTSolverHeavy(blur=3e-2) if name == "heavy" else original(registry, name, *arguments, **options)

    monkeypatch.setattr(ot_measurement, "_build", build)
    request = {"solver": "heavy", "points": 110, "blur": 3e-2, "steps": 1, "exact_points": 0}
    assert ot_measurement.measure(request)["peak_memory_mb"] == pytest.approx(64.0, abs=8.0)


def test_table_and_no_exact_cost():
    finished = bench("--solvers", "geomloss", "--points", "100", "--threads", "1", "--steps", "1", "--exact-points", "50")
    assert finished.exit_code == 0, finished.output
    assert "warm cosine" in finished.stdout
    assert "converged gradient of the same blur" in finished.stdout
    assert "geomloss, points 100, threads 1" in finished.stderr


def test_time_over_is_a_row_and_exit_code_1():
    finished = bench("--solvers", "geomloss", "--points", "100", "--threads", "1", "--timeout", "0.01", "--json")
    assert finished.exit_code == 1
    assert json.loads(finished.stdout)["rows"][0]["error"] == "timeout"


@pytest.mark.parametrize(
    ("arguments", "messages"),
    [
        (["--solvers", "geomlos"], ['ot_solver: got "geomlos"', 'Did you mean "geomloss"']),
        (["--solvers", "pot,"], ["--solvers", "separated by commas"]),
        (["--points", "0"], ["--points: got 0"]),
        (["--threads", "0"], ["--threads: got 0"]),
        (["--blur", "0"], ["--blur: got 0"]),
        (["--steps", "0"], ["--steps: got 0"]),
        (["--exact-points", "-1"], ["--exact-points: got -1"]),
        (["--device", "gpu"], ['--device: got "gpu"']),
    ],
)
def test_unusable_options(arguments, messages):
    finished = bench(*([] if "--solvers" in arguments else ["--solvers", "geomloss"]), *arguments)
    assert finished.exit_code == 2, finished.output
    assert finished.stderr.count("cpdeform: error: ") == 1
    for message in messages:
        assert message in finished.stderr


def test_default_solvers_are_installed():
    assert {"pot", "geomloss"} <= set(default_solvers(load_registry()))


def test_problem_is_the_same_each_time_and_moves_by_the_step():
    source, target = dented_board(500)
    assert torch.equal(source, dented_board(500)[0])
    assert float((target - source).norm(dim=1).max()) > 0.03
    motion = smooth_motion(source, torch.Generator().manual_seed(1))
    assert float(motion.square().sum(dim=1).mean().sqrt()) == pytest.approx(STEP, rel=1e-5)
