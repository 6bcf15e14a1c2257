"""One run at a time writes to a directory."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from children import child_environment

from cpdeform.core.errors import InputError
from cpdeform.core.plugins import load_registry
from cpdeform.planning.optimizer import TrajectoryOptimizer
from cpdeform.planning.result import Observer
from cpdeform.run.deform import deform
from cpdeform.run.record import RunRecorder, load_record
from cpdeform.run.record_lock import LOCK_FILE, RecordLock

HOLDER = """
import sys
from pathlib import Path
from cpdeform.run.record_lock import RecordLock
lock = RecordLock(Path(sys.argv[1]))
lock.acquire()
print("locked", flush=True)
sys.stdin.read()
lock.release()
"""


@pytest.fixture
def run(toy_task_file, toy_entry_points):
    def start(recorder, *observers, **options):
        parts = {"simulator": "toy", "ot_solver": "toy", "placer": "toy", "stages": 1, **options}
        registry, optimizer = load_registry(toy_entry_points), TrajectoryOptimizer(iterations=2)
        return deform(str(toy_task_file), **parts, optimizer=optimizer, registry=registry, observers=[recorder, *observers])

    return start


@pytest.fixture
def holder(tmp_path: Path) -> Iterator[subprocess.Popen[str]]:
    """Another process that has the lock of the directory `run`."""
    (tmp_path / "run").mkdir()
    command = [sys.executable, "-c", HOLDER, str(tmp_path / "run")]
    process = subprocess.Popen(command, env=child_environment(), text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert process.stdout is not None
    assert process.stdout.readline() == "locked\n"
    yield process
    process.kill()
    process.communicate()


def test_the_second_run_is_told_who_writes(tmp_path, run, holder):
    message = rf"another run is writing to \(process {holder.pid}\)"
    for overwrite in (True, False):
        with pytest.raises(InputError, match=message):
            RunRecorder(tmp_path / "run", overwrite=overwrite)
    assert [path.name for path in (tmp_path / "run").iterdir()] == [LOCK_FILE]


def test_a_run_that_began_meanwhile_is_found(tmp_path, run, holder):
    """Both passed the first check, then one of them began."""
    holder.send_signal(signal.SIGKILL)
    holder.wait()
    recorder = RunRecorder(tmp_path / "run", overwrite=True)
    environment, command = child_environment(), [sys.executable, "-c", HOLDER, str(tmp_path / "run")]
    with subprocess.Popen(command, env=environment, text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout.readline() == "locked\n"
        with pytest.raises(InputError, match=rf"process {process.pid}"):
            run(recorder)
        process.communicate("")
    assert list((tmp_path / "run").iterdir()) == []


def test_a_killed_run_leaves_no_lock(tmp_path, run, holder):
    holder.send_signal(signal.SIGKILL)
    holder.wait()
    assert (tmp_path / "run" / LOCK_FILE).exists()
    run(RunRecorder(tmp_path / "run"))
    assert load_record(tmp_path / "run").status == "finished"
    assert not (tmp_path / "run" / LOCK_FILE).exists()


def test_the_lock_is_there_while_the_run_goes_on(tmp_path, run):
    class Look(Observer):
        process = None

        def iteration_finished(self, stage, iteration):
            self.process = int((tmp_path / "run" / LOCK_FILE).read_text())

    look = Look()
    run(RunRecorder(tmp_path / "run"), look)
    assert look.process == os.getpid()
    assert not (tmp_path / "run" / LOCK_FILE).exists()


def test_a_run_that_broke_off_here_locks_nothing(tmp_path, run):
    class Break(Observer):
        def iteration_finished(self, stage, iteration):
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError) as kept:
        run(RunRecorder(tmp_path / "run"), Break())
    run(RunRecorder(tmp_path / "run", overwrite=True))
    assert json.loads((tmp_path / "run" / "run.json").read_text())["status"] == "finished"
    assert kept.type is ZeroDivisionError
    lock = RecordLock(tmp_path / "run")
    lock.acquire()
    lock.release()
    assert not (tmp_path / "run" / LOCK_FILE).exists()
