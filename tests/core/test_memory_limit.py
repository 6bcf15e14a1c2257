"""What a run needs is held against what there is, before it starts."""

from __future__ import annotations

import subprocess
import sys

import pytest

from cpdeform.core import memory_limit
from cpdeform.core.errors import InputError
from cpdeform.core.memory_limit import available_memory
from cpdeform.core.plugins import load_registry
from cpdeform.core.task import changed_task, load_task
from cpdeform.run.deform import deform
from cpdeform.run.record import RunRecorder


def write_group(root, name, *, files, group):
    (root / "proc/self").mkdir(parents=True, exist_ok=True)
    (root / "proc/self/cgroup").write_text(f"{group}\n")
    folder = root / "sys/fs/cgroup" / name
    folder.mkdir(parents=True, exist_ok=True)
    for file, text in files.items():
        (folder / file).write_text(f"{text}\n")


def test_the_control_group_and_those_around_it_count(tmp_path):
    unlimited = {"memory.max": "max", "memory.current": 10, "memory.stat": "inactive_file 0"}
    write_group(tmp_path, "outer/inner", files=unlimited, group="0::/outer/inner")
    free = available_memory(root=tmp_path)
    assert free > 10_000_000
    limited = {"memory.max": 5_000_000, "memory.current": 3_000_000, "memory.stat": "anon 7\ninactive_file 1_000"}
    write_group(tmp_path, "outer", files=limited, group="0::/outer/inner")
    assert available_memory(root=tmp_path) == 2_001_000
    full = {**limited, "memory.current": 6_000_000}
    write_group(tmp_path, "outer/inner", files=full, group="0::/outer/inner")
    assert available_memory(root=tmp_path) == 0


def test_the_first_version_of_control_groups(tmp_path):
    files = {"memory.limit_in_bytes": 9_000_000, "memory.usage_in_bytes": 2_000_000, "memory.stat": "total_inactive_file 500"}
    write_group(tmp_path, "memory/a", files=files, group="4:cpu,memory:/a")
    assert available_memory(root=tmp_path) == 7_000_500


def test_the_limit_of_the_process_counts():
    script = (
        "import resource\n"
        "from cpdeform.core.memory_limit import available_memory\n"
        "import psutil, torch\n"
        "before = available_memory()\n"
        "limit = psutil.Process().memory_info().vms + 300_000_000\n"
        "resource.setrlimit(resource.RLIMIT_AS, (limit, limit))\n"
        "print(before, available_memory())\n"
    )
    finished = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    before, after = map(int, finished.stdout.split())
    assert 0.5 * 300_000_000 < after <= 300_000_000 < before


@pytest.mark.parametrize(("worlds", "remedy"), [(1, r"Take fewer particles or steps"), (3, "batch_size=1")])
def test_a_run_that_needs_more_than_there_is_does_not_start(tmp_path, toy_task_file, toy_entry_points, monkeypatch, worlds, remedy):
    task = load_task(toy_task_file)
    needed = 8 * worlds * 5 * 60 * 3 + worlds * 60 * 2 * 8 * 21
    parts = {"simulator": "toy", "ot_solver": "toy", "placer": "toy", "registry": load_registry(toy_entry_points)}
    recorder = RunRecorder(tmp_path / "run")
    monkeypatch.setattr(memory_limit, "available_memory", lambda device: needed - 1)
    with pytest.raises(InputError, match=rf"memory: got a need of .*worlds {worlds}.*{remedy}"):
        deform(task, observers=[recorder], **parts)
    assert recorder.started == (worlds > 1)
    monkeypatch.setattr(memory_limit, "available_memory", lambda device: 8 * 3 * 5 * 60 * 3 + 3 * 60 * 2 * 8 * 21)
    assert deform(task, stages=1, **parts).stages


def test_a_need_of_terabytes_is_refused_at_once(toy_task_file, toy_entry_points):
    task = changed_task(load_task(toy_task_file), step_count=100_000, scene={"bodies": {"0": {"particle_count": 10_000_000}}})
    parts = {"simulator": "toy", "ot_solver": "toy", "placer": "toy", "registry": load_registry(toy_entry_points)}
    with pytest.raises(InputError, match=r"memory: got a need of 2\.4e\+04 GB"):
        deform(task, **parts)
