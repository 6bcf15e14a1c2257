from __future__ import annotations

import dataclasses
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import h5py
import pytest
import torch

from cpdeform.core.errors import InputError, RecordError
from cpdeform.core.plugins import load_registry
from cpdeform.planning.optimizer import TrajectoryOptimizer
from cpdeform.planning.result import Observer
from cpdeform.run import record_files
from cpdeform.run.configuration import RunConfiguration
from cpdeform.run.deform import deform
from cpdeform.run.record import RunRecorder, load_record, save_result

SECONDS_TO_WAIT = 60.0


@pytest.fixture
def run(toy_task_file, toy_entry_points):
    def start(**options):
        optimizer = TrajectoryOptimizer(iterations=3)
        parts = {"simulator": "toy", "ot_solver": "toy", "placer": "toy"}
        registry = load_registry(toy_entry_points)
        return deform(str(toy_task_file), **{**parts, "optimizer": optimizer, "registry": registry, **options})

    return start


def assert_same_state(first, second):
    for field in dataclasses.fields(first):
        assert torch.equal(getattr(first, field.name), getattr(second, field.name)), field.name


def contents(directory: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in directory.iterdir()}


def test_what_is_saved_is_what_is_loaded(tmp_path, run):
    result = run()
    assert result.save(tmp_path / "deep" / "run") == tmp_path / "deep" / "run"
    record = load_record(tmp_path / "deep" / "run")
    assert sorted(contents(record.directory)) == ["goal.h5", "metrics.jsonl", "run.json", "stage-000.h5", "stage-001.h5"]
    assert (record.status, record.finished_stages) == ("finished", 2)
    assert record.task == result.task.model_copy(update={"goal": record.directory / "goal.h5"})
    assert torch.equal(record.goal, result.goal)
    for field in ("loss_initial", "loss_final", "metric_value", "gradient_evaluations", "seconds", "seed"):
        assert record.run[field] == getattr(result, field)
    assert {"python", "torch", "warp-lang", "numpy", "pot", "geomloss", "cpdeform"} <= set(record.run["versions"])
    for saved, loaded in zip(result.stages, record.stages, strict=True):
        assert_same_state(saved.state, loaded.state)
        assert_same_state(saved.state_before, loaded.state_before)
        for field in ("index", "status", "best", "loss_before", "loss", "gradient_evaluations", "seconds"):
            assert getattr(saved, field) == getattr(loaded, field)
        for field in ("priorities", "actions", "tool_poses"):
            assert torch.equal(getattr(saved, field), getattr(loaded, field))
        assert torch.equal(saved.positions.float(), loaded.positions)
        for before, after in zip(saved.candidates, loaded.candidates, strict=True):
            assert torch.equal(before.proposal.pose, after.proposal.pose)
            assert torch.equal(before.actions, after.actions)
            assert (before.loss, before.proposal.label) == (after.loss, after.proposal.label)
            assert before.proposal.contact_particle == after.proposal.contact_particle
    lines = [(line["kind"], line["stage"], line.get("iteration")) for line in record.metrics]
    stage = [*(("iteration", 0, index) for index in range(3)), ("stage", 0, None)]
    assert lines == stage + [(kind, 1, number) for kind, _, number in stage]
    assert len(record.metrics[0]["loss"]) == 3
    assert set(record.metrics[0]["seconds"]) == {"rollout", "objective", "vjp", "optimizer"}


def test_datasets_say_what_they_hold(tmp_path, run):
    run(stages=1).save(tmp_path / "run")
    described = []

    def check(name, item):
        if isinstance(item, h5py.Dataset):
            assert item.attrs["units"], name
            assert len(item.attrs["shape"].split(",")) == item.ndim, name
            described.append(name)

    with h5py.File(tmp_path / "run" / "stage-000.h5") as file:
        file.visititems(check)
        assert file["positions"].dtype == "float32"
    assert {"state/position", "state_before/affine", "priorities", "placements/pose", "actions"} <= set(described)


def test_recorded_during_the_run_and_after_it_is_the_same(tmp_path, run):
    result = run(observers=[RunRecorder(tmp_path / "during")])
    save_result(result, tmp_path / "after")
    during, after = contents(tmp_path / "during"), contents(tmp_path / "after")
    assert during.keys() == after.keys()
    assert during["metrics.jsonl"] == after["metrics.jsonl"]
    runs = [json.loads(files["run.json"]) for files in (during, after)]
    for content in runs:
        del content["recorded_at"]
    assert runs[0] == runs[1]


def test_memory_is_recorded(tmp_path, run):
    class Listener(Observer):
        told = ()

        def optimization_started(self, stage, worlds, memory_estimate):
            self.told += ((stage, worlds, memory_estimate),)

    listener = Listener()
    result = run(observers=[listener, RunRecorder(tmp_path / "run")])
    estimate = 8 * 3 * 5 * 60 * 3
    assert listener.told == ((0, 3, estimate), (1, 3, estimate))
    memory = load_record(tmp_path / "run").run["memory"]
    peaks = [item.memory.peak for stage in result.stages for item in stage.history if item.memory is not None]
    assert memory == {"worlds": 3, "estimate_bytes": estimate, "peak_bytes": max(peaks)}
    assert result.memory.peak == max(peaks)
    measured = [iteration.memory is not None for iteration in result.stages[0].history]
    assert measured == [False, True, False]


def test_a_run_goes_on_from_its_record(tmp_path, run):
    first = run(stages=1, observers=[RunRecorder(tmp_path / "run", configuration=RunConfiguration(stages=1))])
    record = load_record(tmp_path / "run")
    assert record.run["configuration"]["stages"] == 1
    second = run(stages=1, state=record.state)
    assert second.loss_initial == pytest.approx(first.loss_final)


def test_numbers_that_are_not_finite(tmp_path, run):
    from cpdeform_toy.simulator import SimulatorToy

    from cpdeform.core.task import load_task

    task = load_task(tmp_path / "shift.yaml")
    result = run(simulator=SimulatorToy(task.scene, batch_size=3, break_above=-2.0))
    record = load_record(save_result(result, tmp_path / "run"))
    assert record.status == "non_finite"
    assert "NaN" not in (tmp_path / "run" / "metrics.jsonl").read_text()
    assert record.metrics[0]["loss"] == [None] * 3
    assert record.stages[0].candidates[0].loss == float("inf")
    assert record.stages[0].positions is None


def test_directory_that_is_not_empty(tmp_path, run):
    result = run(stages=2)
    directory = result.save(tmp_path / "run")
    (directory / "notes.txt").write_text("mine")
    (directory / "picture.png").write_text("of the old run")
    before = contents(directory)
    for attempt in (lambda: RunRecorder(directory), lambda: result.save(directory)):
        with pytest.raises(InputError, match=r"a directory that is not empty.*--overwrite"):
            attempt()
    assert contents(directory) == before
    recorder = RunRecorder(directory, overwrite=True)
    assert contents(directory) == before
    run(stages=1, observers=[recorder])
    after = contents(directory)
    assert sorted(after) == ["goal.h5", "metrics.jsonl", "notes.txt", "run.json", "stage-000.h5"]
    assert after["notes.txt"] == b"mine"


def test_directory_that_cannot_be_written(tmp_path):
    (tmp_path / "file").write_text("")
    for path in (tmp_path / "file", tmp_path / "file" / "run", Path("/proc/cpdeform/run")):
        with pytest.raises(InputError, match="output directory"):
            RunRecorder(path)
    if os.geteuid() != 0:
        (tmp_path / "closed").mkdir(mode=0o500)
        with pytest.raises(InputError, match="cannot be written"):
            RunRecorder(tmp_path / "closed" / "run")


def test_nothing_is_written_before_the_run_starts(tmp_path):
    recorder = RunRecorder(tmp_path / "a" / "b")
    with pytest.raises(ZeroDivisionError), recorder:
        _ = 1 / 0
    assert not (tmp_path / "a").exists()
    assert not recorder.started


@pytest.mark.parametrize(("error", "status"), [(KeyboardInterrupt(), "interrupted"), (RuntimeError("boom"), "failed")])
def test_a_run_that_breaks_off_says_so(tmp_path, run, error, status):
    class Break(Observer):
        def optimization_started(self, stage, worlds, memory_estimate):
            if stage == 1:
                raise error

    recorder = RunRecorder(tmp_path / "run")
    with pytest.raises(type(error)), recorder:
        run(observers=[recorder, Break()])
    record = load_record(tmp_path / "run")
    assert (record.status, record.finished_stages) == (status, 1)
    assert record.metrics[-1]["kind"] == "stage"


def test_a_failing_disk_leaves_no_half_file(tmp_path, run, monkeypatch):
    def fail(self, target):
        if target.name == "stage-000.h5":
            raise OSError(28, "No space left on device")
        return os.replace(self, target)

    monkeypatch.setattr(Path, "replace", fail)
    with pytest.raises(RecordError, match="No space left on device"):
        run(observers=[RunRecorder(tmp_path / "run")])
    assert sorted(contents(tmp_path / "run")) == ["goal.h5", "metrics.jsonl", "run.json"]


def test_damaged_records(tmp_path, run):
    with pytest.raises(InputError, match=r"no run\.json"):
        load_record(tmp_path / "absent")
    directory = run(stages=1).save(tmp_path / "run")
    (directory / "stage-000.h5").write_bytes(b"half")
    with pytest.raises(InputError, match="damaged"):
        load_record(directory)
    (directory / "run.json").write_text("{")
    with pytest.raises(InputError, match="unreadable"):
        load_record(directory)


def fill(name, number):
    def change(file):
        values = file[name][()]
        values[...] = number
        del file[name]
        file[name] = values

    return change


def replace_group(file):
    del file["state"]
    file["state"] = 1.0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (fill("state/position", float("nan")), r"stage-000\.h5: state/position: got 180 values that are nan"),
        (fill("state_before/velocity", float("nan")), r"state_before/velocity: got 180 values"),
        (fill("tool_poses", float("nan")), r"stage-000\.h5: tool_poses: got 48 values"),
        (fill("state/position", 7.0), r"state/position: got positions from 7 to 7, expected positions in the domain"),
        (fill("placements/contact_particle", 60), "contact_particle: got 60 to 60, expected -1 to 59"),
        (replace_group, "state/position: got|no array of that name"),
        (lambda file: file.attrs.__setitem__("best", 3), r"best: got 3, expected one of 3 candidates"),
        (lambda file: file.attrs.__setitem__("index", 1.5), "index: got"),
        (lambda file: file.attrs.__setitem__("seconds", "[1]"), "seconds: got list"),
        (lambda file: file.__delitem__("actions"), "a finished stage without a plan"),
    ],
)
def test_a_damaged_stage_is_named(tmp_path, run, change, message):
    directory = run(stages=1).save(tmp_path / "run")
    with h5py.File(directory / "stage-000.h5", "a") as file:
        change(file)
    with pytest.raises(InputError, match=message) as caught:
        load_record(directory)
    assert str(caught.value).startswith("run record ")


@pytest.mark.parametrize(
    ("field", "value"), [("names", "warp"), ("seed", -1), ("seed", 2**70), ("status", 5), ("metric_value", "x")]
)
def test_fields_of_the_run_that_are_something_else(tmp_path, run, field, value):
    directory = run(stages=1).save(tmp_path / "run")
    content = json.loads((directory / "run.json").read_text())
    (directory / "run.json").write_text(json.dumps({**content, field: value}))
    with pytest.raises(InputError, match=rf"run\.json: {field}"):
        load_record(directory)


def test_temporary_files_belong_to_the_record(tmp_path):
    names = [".run.tmp.json", ".stage-003.tmp.h5", ".animation.tmp.mp4", "stage-1000.h5", "picture.png"]
    for name in [*names, "stage-x.h5", ".hidden", "run.json.bak"]:
        (tmp_path / name).write_text("")
    assert {path.name for path in record_files.own_files(tmp_path)} == set(names)


KILLED = """
import sys
sys.path.insert(0, {toys!r})
import importlib.metadata
from cpdeform.run.deform import deform
from cpdeform.planning.optimizer import TrajectoryOptimizer
from cpdeform.core.plugins import load_registry
from cpdeform.run.record import RunRecorder
from cpdeform.core.task import load_task
from cpdeform_toy.simulator import SimulatorToy

class Slow(SimulatorToy):
    def rollout(self, state, actions):
        self.delay = 0.02 if float(state.position[0, :, 0].mean()) > 0.41 else 0.0
        return super().rollout(state, actions)

task = load_task({task!r})
modules = {{"toy": "cpdeform_toy.plugin", "strategies": "cpdeform.planning.plugin"}}
registry = load_registry([importlib.metadata.EntryPoint(name, module, "cpdeform") for name, module in modules.items()])
deform(task, simulator=Slow(task.scene, batch_size=4), ot_solver="toy", placer="toy", stages=2, registry=registry,
       optimizer=TrajectoryOptimizer(iterations=100000, patience=20), observers=[RunRecorder({out!r})])
"""


def test_a_killed_run_leaves_a_readable_record(tmp_path, toy_task_file):
    """Killed with signal 9 in the second stage: the first one is complete, and nothing else stands in the way of reading it."""
    from toy_fixtures import TOYS

    out = tmp_path / "run"
    script = KILLED.format(toys=str(TOYS), task=str(toy_task_file), out=str(out))
    process = subprocess.Popen([sys.executable, "-c", script])
    try:
        limit = time.monotonic() + SECONDS_TO_WAIT
        metrics = out / "metrics.jsonl"
        while not (metrics.exists() and '"stage": 1, "batch"' in metrics.read_text()):
            assert process.poll() is None
            assert time.monotonic() < limit
            time.sleep(0.01)
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
    # The line that was being written when the process died may be cut off.
    with metrics.open("a") as file:
        file.write('{"kind": "iter')
    record = load_record(out)
    assert (record.status, record.finished_stages, len(record.stages)) == ("running", 1, 1)
    assert sum(line["kind"] == "stage" for line in record.metrics) == 1
    assert record.state.particle_count == 60
