"""Runs that are killed, interrupted or out of space at random moments: each leaves a record that can be read and gone on from."""

from __future__ import annotations

import dataclasses
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from children import child_environment, interruptible_command, small_disk
from toy_fixtures import write_toy_distribution, write_toy_task
from typer.testing import CliRunner

from cpdeform.cli.main import app
from cpdeform.run.record import load_record
from cpdeform.run.record_reader import RunRecord

pytestmark = pytest.mark.faults

PARTS = ["--backend", "toy", "--ot", "toy", "--placer", "toy", "--iterations", "6", "--seed", "3"]
STAGES = 6
SLOW = ["--set", "simulator_options.delay=0.03"]
RUNS = 20
SECONDS_TO_WAIT = 180.0


@pytest.fixture(scope="module")
def place(tmp_path_factory) -> tuple[Path, Path]:
    """A directory with the toy task, and the toys' distribution."""
    directory = tmp_path_factory.mktemp("runs")
    write_toy_task(directory, stage_count=STAGES, offset=0.3)
    return directory, write_toy_distribution(directory)


@pytest.fixture(scope="module")
def whole(place) -> RunRecord:
    """The run that nothing disturbs."""
    finished = command(place, "run", "shift.yaml", *PARTS, "--no-pictures", "--out", "whole")
    assert finished.returncode == 0, finished.stderr
    return load_record(place[0] / "whole")


def command(place: tuple[Path, Path], *arguments: object) -> subprocess.CompletedProcess[str]:
    line = [sys.executable, "-m", "cpdeform", *map(str, arguments)]
    return subprocess.run(line, cwd=place[0], env=child_environment(place[1]), capture_output=True, text=True)


@pytest.fixture
def invoke(place, monkeypatch) -> Callable[..., Any]:
    """Calls the command in this process, which takes a tenth of the time of one of its own."""
    monkeypatch.chdir(place[0])
    monkeypatch.syspath_prepend(str(place[1]))
    return lambda *arguments: CliRunner().invoke(app, [*map(str, arguments), "--no-pictures"])


def disturbed(place: tuple[Path, Path], out: str, wait: float, *signals: int) -> subprocess.Popen[str]:
    """Start a run, and send it signals some seconds after its record began."""
    line = interruptible_command(["run", "shift.yaml", *PARTS, *SLOW, "--no-pictures", "--out", out])
    environment = child_environment(place[1])
    process = subprocess.Popen(line, cwd=place[0], env=environment, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    limit = time.monotonic() + SECONDS_TO_WAIT
    while not (place[0] / out / "run.json").exists() and process.poll() is None and time.monotonic() < limit:
        time.sleep(0.005)
    time.sleep(wait)
    for number in signals:
        process.send_signal(number)
        time.sleep(0.01)
    return process


def assert_same(record: RunRecord, other: RunRecord) -> None:
    """The last states are equal, bit for bit."""
    for field in dataclasses.fields(record.state):
        assert torch.equal(getattr(record.state, field.name), getattr(other.state, field.name)), field.name


@pytest.mark.parametrize("number", range(RUNS))
def test_killed_runs_go_on_bit_for_bit(place, whole, invoke, number):
    wait, out = random.Random(number).uniform(0.0, 2.0), f"killed-{number}"
    disturbed(place, out, wait, signal.SIGKILL).communicate(timeout=SECONDS_TO_WAIT)
    record = load_record(place[0] / out)
    assert record.status in ("running", "finished")
    left = len(whole.stages) - len(record.stages)
    if not left:
        assert_same(record, whole)
    elif record.stages:
        for stage, expected in zip(record.stages, whole.stages, strict=False):
            assert torch.equal(stage.state.position, expected.state.position)
        finished = invoke("run", "--resume", out, "--out", f"{out}-rest")
        assert finished.exit_code in (0, 1), finished.output
        assert_same(load_record(place[0] / f"{out}-rest"), whole)
    else:
        # A killed run holds no lock: the same directory may be taken again.
        finished = invoke("run", "shift.yaml", *PARTS, "--out", out, "--overwrite")
        assert finished.exit_code == 0, finished.output
        assert_same(load_record(place[0] / out), whole)


@pytest.mark.parametrize("number", range(RUNS))
def test_interrupted_runs_are_complete(place, invoke, number):
    chance, out = random.Random(number), f"interrupted-{number}"
    name, code = chance.choice([("SIGINT", 130), ("SIGTERM", 143), ("SIGHUP", 129)])
    process = disturbed(place, out, chance.uniform(0.0, 1.0), *[getattr(signal, name)] * chance.randint(1, 5))
    _, errors = process.communicate(timeout=SECONDS_TO_WAIT)
    assert "Traceback" not in errors
    assert "Exception ignored" not in errors
    record = load_record(place[0] / out)
    if process.returncode == 0:
        assert record.status == "finished"
        return
    assert process.returncode == code, errors
    assert errors.splitlines()[-1].startswith("cpdeform: interrupted")
    assert record.status == "interrupted"
    if record.stages:
        finished = invoke("run", "--resume", out, "--out", f"{out}-rest", "--stages", 1)
        assert finished.exit_code in (0, 1), finished.output
        rest = load_record(place[0] / f"{out}-rest")
        assert rest.stages[0].index == record.next_stage
        assert torch.equal(rest.stages[0].state_before.position, record.state.position)


@pytest.mark.parametrize("kilobytes", [4, 8, 16, 24, 32, 48, 64, 80, 96, 112, 128, 160])
def test_full_disks(place, tmp_path, kilobytes):
    with small_disk(tmp_path, kilobytes) as disk:
        finished = command(place, "run", "shift.yaml", *PARTS, "--no-pictures", "--out", disk / "run")
        assert finished.returncode == 2, finished.stderr
        assert "No space left on device" in finished.stderr.splitlines()[-1]
        assert "Traceback" not in finished.stderr
        assert "Exception ignored" not in finished.stderr
        if (disk / "run" / "run.json").exists() and (disk / "run" / "metrics.jsonl").exists():
            record = load_record(disk / "run")
            assert [stage.index for stage in record.stages] == list(range(len(record.stages)))


def test_ten_runs_into_one_directory(place, whole):
    """Whoever comes first writes; the others are refused, and nothing is mixed."""
    line = [sys.executable, "-m", "cpdeform", "run", "shift.yaml", *PARTS, "--no-pictures", "--out", "shared", "--overwrite", *SLOW]
    options = {"cwd": place[0], "env": child_environment(place[1]), "text": True, "stderr": subprocess.PIPE}
    processes = [subprocess.Popen(line, stdout=subprocess.DEVNULL, **options) for _ in range(10)]
    errors = [process.communicate(timeout=10 * SECONDS_TO_WAIT)[1] for process in processes]
    codes = [process.returncode for process in processes]
    assert 0 in codes
    assert set(codes) <= {0, 2}
    for code, error in zip(codes, errors, strict=True):
        assert code == 0 or "another run is writing to" in error, error
    record = load_record(place[0] / "shared")
    assert_same(record, whole)
    assert len([line for line in record.metrics if line["kind"] == "stage"]) == len(record.stages)
