"""A disk without room ends a run with one line and exit code 2; what was recorded before stays."""

from __future__ import annotations

import json
import resource
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import h5py
import pytest
from children import child_environment, small_disk

from cpdeform.run.record import load_record
from cpdeform.run.record_files import replacing_hdf5

COMMAND = ["run", "shift.yaml", "--backend", "toy", "--ot", "toy", "--placer", "toy", "--iterations", "3", "--no-pictures"]


@pytest.fixture
def run(tmp_path: Path, toy_distribution: Path, toy_task_file: Path) -> Callable[..., subprocess.CompletedProcess[str]]:
    """Runs the toy task in a process of its own."""

    def start(*arguments: object, prepare: Callable[[], None] | None = None) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "cpdeform", *COMMAND, *map(str, arguments)]
        environment = child_environment(toy_distribution)
        return subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, preexec_fn=prepare)

    return start


def assert_one_line(finished: subprocess.CompletedProcess[str], *words: str) -> None:
    assert finished.returncode == 2, finished.stderr
    last = finished.stderr.splitlines()[-1]
    assert last.startswith("cpdeform: error: cannot write the run record in ")
    assert all(word in last for word in words), last
    # Neither traces nor complaints of destructors, which Python prints and goes on.
    assert "Traceback" not in finished.stderr
    assert "Exception ignored" not in finished.stderr


def test_a_disk_that_is_full_at_the_second_stage(tmp_path, run):
    with small_disk(tmp_path, 256) as disk:
        (disk / "others").write_bytes(bytes(1024 * 128))
        finished = run("--stages", 12, "--out", disk / "run")
        assert_one_line(finished, "No space left on device", "--out")
        record = load_record(disk / "run")
        # Some stages are complete; the one that found no room left nothing behind.
        assert 0 < len(record.stages) < 12
        assert record.run["stages_finished"] == len(record.stages)
        assert not [path for path in (disk / "run").iterdir() if path.name.startswith(".")]


def test_files_that_may_not_grow(tmp_path, run):
    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, 10_000))

    finished = run("--out", "run", prepare=limit)
    assert_one_line(finished, "File too large")
    assert not [path for path in (tmp_path / "run").iterdir() if path.name.startswith(".")]
    assert json.loads((tmp_path / "run" / "run.json").read_text())["stages_finished"] == 0


def test_a_file_that_is_not_finished_leaves_the_old_one(tmp_path):
    path = tmp_path / "file.h5"
    with replacing_hdf5(path) as file:
        file["old"] = [1.0]
    with pytest.raises(ZeroDivisionError), replacing_hdf5(path) as file:
        file["new"] = [1.0 / 0]
    with h5py.File(path) as file:
        assert list(file) == ["old"]
    assert list(tmp_path.iterdir()) == [path]
