"""A task file and a record as the version before wrote them, in `tests/data/format-2`: a goal was a target, tools manipulators."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import h5py
import pytest
import torch

from cpdeform.core.errors import InputError
from cpdeform.core.plugins import load_registry
from cpdeform.core.task import load_task
from cpdeform.report.draw import draw_run
from cpdeform.run.deform import deform
from cpdeform.run.evaluation import evaluate_record
from cpdeform.run.record_reader import load_record
from cpdeform.run.resolve import resolve

DATA = Path(__file__).parents[1] / "data" / "format-2"
TOYS = {"simulator": "toy", "ot_solver": "toy", "placer": "toy"}


@pytest.fixture
def old(tmp_path: Path) -> Path:
    """A copy of the record elsewhere, without the task's own files."""
    return Path(shutil.copytree(DATA / "record", tmp_path / "old"))


def test_the_data_have_the_old_names() -> None:
    run = json.loads((DATA / "record" / "run.json").read_text())
    assert run["format"] == 2
    assert {"target", "scene"} <= set(run["task"])
    assert "manipulators" in run["task"]["scene"]
    with h5py.File(DATA / "record" / "stage-000.h5") as file:
        assert {"manipulator_poses", "state/manipulator_pose"} < {*file, *(f"state/{name}" for name in file["state"])}


def test_an_old_record_is_read_with_all_that_it_holds(old: Path) -> None:
    record = load_record(old)
    (stage,) = record.stages
    assert (record.format, record.finished_stages, len(record.task.scene.tools)) == (2, 1, 1)
    with h5py.File(old / "stage-000.h5") as file:
        assert torch.equal(stage.state.tool_pose, torch.as_tensor(file["state/manipulator_pose"][()]))
        assert stage.tool_poses is not None
        assert torch.equal(stage.tool_poses, torch.as_tensor(file["manipulator_poses"][()]))
    with h5py.File(old / "target.h5") as file:
        assert torch.equal(record.goal, torch.as_tensor(file["position"][()]))
    assert torch.equal(torch.as_tensor(record.task.load_goal()).to(record.goal), record.goal)
    assert record.task.scene.tools[0].friction == 0.5


def test_an_old_record_is_evaluated_and_drawn(old: Path) -> None:
    evaluation = evaluate_record(load_record(old))
    assert evaluation.wasserstein_final < evaluation.wasserstein_start
    assert (evaluation.particle_count, evaluation.goal_count) == (60, 60)
    assert draw_run(old).is_file()


def test_an_old_run_goes_on_as_the_same_run_of_today(old: Path, tmp_path: Path, toy_entry_points) -> None:
    registry = load_registry(toy_entry_points)
    rest = deform(resume=old, stages=1, registry=registry)
    rest.save(tmp_path / "rest")
    record = load_record(tmp_path / "rest")
    assert (record.format, record.stages[0].index, (tmp_path / "rest" / "goal.h5").is_file()) == (3, 1, True)
    shutil.copy(DATA / "target.npz", tmp_path)
    options = {"optimizer": {"iterations": 3}, "scene": {"manipulators": {"0": {"friction": 0.5}}}}
    task = str(shutil.copy(DATA / "shift.yaml", tmp_path))
    whole = deform(task, **TOYS, seed=3, stages=2, settings=options, registry=registry)
    assert torch.equal(whole.stages[0].state.position, load_record(old).state.position)
    assert torch.equal(whole.stages[1].state.position, record.state.position)


def test_an_old_record_is_replaced_whole(old: Path, toy_entry_points) -> None:
    result = deform(load_task(DATA / "shift.yaml"), **TOYS, stages=1, registry=load_registry(toy_entry_points))
    result.save(old, overwrite=True)
    assert sorted(path.name for path in old.iterdir()) == ["goal.h5", "metrics.jsonl", "run.json", "stage-000.h5"]


def test_an_old_task_file_is_read() -> None:
    task = load_task(DATA / "shift.yaml")
    assert (len(task.scene.tools), task.goal, task.load_goal().shape) == (1, DATA / "target.npz", (60, 3))


def test_changes_under_old_names_count(toy_entry_points) -> None:
    values = {"target": str(DATA / "target.npz"), "scene": {"manipulators": {"0": {"friction": 0.25}}}, "backend": "toy"}
    found = resolve(
        {**values, "ot": "toy", "placer": "toy"}, task=load_task(DATA / "shift.yaml"), registry=load_registry(toy_entry_points)
    )
    assert found.task.scene.tools[0].friction == 0.25
    assert found.configuration.goal == DATA / "target.npz"


@pytest.mark.parametrize(
    ("addition", "message"),
    [
        ("goal: target.npz\n", r"shift\.yaml: target: got both `target` and `goal`, expected `goal` alone"),
        ("variants: {a: {scene: {tools: {}, manipulators: {}}}}\n", "manipulators: got both `manipulators` and `tools`"),
        ("limits: {tools: {}, manipulators: {}}\n", "Remove `manipulators`, the old name of `tools`"),
    ],
)
def test_both_names_at_once_are_refused(tmp_path: Path, addition: str, message: str) -> None:
    path = tmp_path / "shift.yaml"
    path.write_text((DATA / "shift.yaml").read_text() + addition)
    with pytest.raises(InputError, match=message):
        load_task(path)
