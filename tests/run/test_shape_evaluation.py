"""Shape figures of a record: at rest and not, on the command line, and in the rows of an experiment."""

from __future__ import annotations

import dataclasses
import json
import shutil

import numpy as np
import pytest
import torch
from toy_fixtures import write_toy_distribution, write_toy_task
from typer.testing import CliRunner

from cpdeform.cli.main import app
from cpdeform.core.errors import InputError, PluginError
from cpdeform.core.goal import write_goal
from cpdeform.core.plugins import load_registry
from cpdeform.core.sampling import sample_particles
from cpdeform.core.state import initial_state
from cpdeform.core.task import load_task
from cpdeform.experiments.experiment_plan import PlannedRun
from cpdeform.experiments.experiment_row import read_row
from cpdeform.experiments.experiment_tables import runs_table
from cpdeform.experiments.shape_figures import SHAPE_FIGURES
from cpdeform.run.record import load_record
from cpdeform.run.shape_evaluation import RestFigures, evaluate_shape, evaluate_shape_record
from cpdeform.run.shape_text import shape_text

FLOOR = 3 / 64
FALL = 0.02
SCENE = {
    "bodies": [{"kind": "box", "position": [0.4, FLOOR + FALL + 0.04, 0.5], "widths": [0.1, 0.08, 0.1], "particle_count": 800}],
    "tools": [{"kind": "Sphere", "radius": 0.05, "position": [0.4, 0.4, 0.5], "action_scale": [0.02, 0.02, 0.02]}],
}


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """The directory of a task and of a recorded run of it: a block above the floor that the toy tool shifts."""
    folder = tmp_path_factory.mktemp("recorded")
    write_toy_task(folder, scene=SCENE, stage_count=1)
    task = load_task(folder / "shift.yaml")
    write_goal(task.goal, sample_particles(task.scene) + np.array([0.06, 0.0, 0.0]))
    parts = ["--backend", "toy", "--ot", "toy", "--placer", "toy", "--iterations", "3", "--no-pictures"]
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(write_toy_distribution(folder)))
        patch.chdir(folder)
        made = CliRunner().invoke(app, ["run", "shift.yaml", *parts, "--out", "run"])
        assert made.exit_code == 0, made.output
    return folder


@pytest.fixture(scope="module")
def at_rest(recorded):
    return evaluate_shape_record(load_record(recorded / "run"))


def test_start_result_and_goal_rest_on_the_floor(recorded, at_rest):
    assert at_rest.goal_drop == pytest.approx(FALL, abs=0.004)
    assert at_rest.goal_self_iou > 0.9
    for found in (at_rest.start, at_rest.final, at_rest.goal):
        assert 10 < found.steps <= 500  # the fall itself takes 19 steps
    figures = at_rest.figures
    record = load_record(recorded / "run")
    as_it_is = evaluate_shape_record(record, from_rest=False)
    assert (as_it_is.simulator, as_it_is.goal_drop, as_it_is.start) == (None, None, None)
    # All three fall alike, so the figures are about those of the clouds in the air.
    assert figures.shape_iou_final == pytest.approx(as_it_is.figures.shape_iou_final, abs=0.1)
    assert figures.shape_iou_start == pytest.approx(as_it_is.figures.shape_iou_start, abs=0.1)
    assert figures.shape_iou_start < figures.shape_iou_final - 0.1
    # A goal at rest against clay in the air: the fall counts as a difference.
    start = initial_state(record.task.scene)
    mixed = evaluate_shape(record.task.scene, final=start, goal=record.goal - torch.tensor([0.06, FALL, 0.0]), from_rest=False)
    assert mixed.figures.shape_iou_final < 0.75


def test_the_start_against_itself_is_at_the_top(recorded):
    task = load_task(recorded / "shift.yaml")
    start = initial_state(task.scene)
    found = evaluate_shape(task.scene, final=start, goal=start.position[0])
    # The goal is let go from the same place and put down rigidly: what differs is how the block deforms in its fall.
    assert found.figures.shape_iou_final == found.figures.shape_iou_start == found.goal_self_iou > 0.9
    assert found.figures.distance_95_result_to_goal <= 1.0


def test_evaluate_prints_the_figures(recorded, at_rest, monkeypatch):
    monkeypatch.chdir(recorded)
    found = CliRunner().invoke(app, ["evaluate", "run", "--json"])
    assert found.exit_code == 0, found.output
    figures = json.loads(found.stdout)
    assert figures["shape_iou_final"] == pytest.approx(at_rest.figures.shape_iou_final, abs=1e-6)
    expected = (figures["shape_iou_final"] - figures["shape_iou_start"]) / (
        figures["shape_iou_ceiling"] - figures["shape_iou_start"]
    )
    assert figures["normalised_shape_iou"] == pytest.approx(expected)
    assert len(figures["silhouette_iou"]) == 3
    assert figures["shape_from_rest"] is True
    assert set(figures["shape_rest"]) == {"start", "final", "goal"}
    assert {"loose_share", "distance_95_result_to_goal", "distance_95_goal_to_result", "goal_drop"} <= set(figures)
    plain = json.loads(CliRunner().invoke(app, ["evaluate", "run", "--json", "--no-rest"]).stdout)
    assert (plain["shape_from_rest"], plain["goal_drop"], plain["shape_rest"]["start"]) == (False, None, None)
    text = shape_text(at_rest)
    for part in ("shape IoU", "(from above)", "loose share", "95% distance", "at rest  ", "the goal 0.0"):
        assert part in text
    moving = dataclasses.replace(at_rest, final=RestFigures(steps=500, rests=False, residual=0.25))
    assert "result after 500 steps, STILL MOVES 0.25 cells a step" in shape_text(moving)
    assert "not at rest" in CliRunner().invoke(app, ["evaluate", "run", "--no-rest"]).stdout


def test_rows_have_the_figures_where_they_are_asked_for(recorded, at_rest, tmp_path, monkeypatch):
    shutil.copytree(recorded / "run", tmp_path / "run")
    run = PlannedRun(task="shift", source="shift.yaml", method="fixed", seed=0, directory=tmp_path / "run")
    plain = read_row(run, paper_metric=False, reused=True)
    assert [getattr(plain, name) for name in SHAPE_FIGURES] == [None] * len(SHAPE_FIGURES)
    assert "shape IoU" not in runs_table([plain])
    monkeypatch.setattr("cpdeform.run.shape_evaluation.evaluate_shape_record", lambda record: at_rest)
    row = read_row(run, paper_metric=False, shape=True, reused=True)
    assert row.shape_iou_final == pytest.approx(at_rest.figures.shape_iou_final, abs=1e-6)
    assert row.silhouette_iou_y == pytest.approx(at_rest.figures.silhouette_iou[1], abs=1e-6)
    assert row.w1_final == plain.w1_final
    assert "normalised shape IoU" in runs_table([row])
    # They are kept beside the record.
    monkeypatch.setattr("cpdeform.experiments.experiment_row.judge", None)
    assert read_row(run, paper_metric=False, reused=True) == row


def test_without_a_simulator_there_is_no_rest(recorded):
    record = load_record(recorded / "run")
    with pytest.raises(PluginError, match=r"nothing that is installed.*not at rest"):
        evaluate_shape_record(record, registry=load_registry([]))
    assert evaluate_shape_record(record, from_rest=False, registry=load_registry([])).figures.shape_iou_final > 0.0
    with pytest.raises(InputError, match="positions: got"):
        evaluate_shape(record.task.scene, final=record.state, goal=record.goal + 1.0, from_rest=False)
