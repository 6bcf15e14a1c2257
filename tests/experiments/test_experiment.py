"""`cpdeform experiment`: rows, resuming, failures and tables, with the toy parts."""

from __future__ import annotations

import csv
import io
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from toy_fixtures import write_toy_distribution, write_toy_task
from typer.testing import CliRunner

from cpdeform.cli.main import app
from cpdeform.core.machine import available_cores
from cpdeform.core.plugins import load_registry
from cpdeform.experiments.experiment_job import evaluations_per_stage
from cpdeform.experiments.experiment_plan import METHODS, TASKS, expand_tasks
from cpdeform.experiments.experiment_row import ExperimentRow, without_directories
from cpdeform.experiments.experiment_tables import csv_text, paper_figures, short_table, table_text
from cpdeform.planning.objectives.mass import mass_grid
from cpdeform.planning.objectives.metrics import soft_iou
from cpdeform.run.record import load_record

QUICK = ["--backend", "toy", "--ot", "toy", "--iterations", "3", "--stages", "1"]


def invoke(*arguments, name="multi-stage"):
    return CliRunner().invoke(app, ["experiment", name, *(str(argument) for argument in arguments)])


def run_toy(*arguments, methods="fixed"):
    return invoke("--tasks", "shift.yaml", "--methods", methods, *QUICK, *arguments)


def table(out="out"):
    return list(csv.DictReader(io.StringIO((Path(out) / "table.csv").read_text())))


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A directory with the toys installed, a task and the experiment `out`, not to be changed."""
    folder = tmp_path_factory.mktemp("made")
    write_toy_task(folder)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(write_toy_distribution(folder)))
        patch.chdir(folder)
        finished = run_toy("--seeds", "0,1", "--out", "out", "--json", methods="cpdeform,fixed")
        assert finished.exit_code == 0, finished.output
        (folder / "stdout.json").write_text(finished.stdout)
        (folder / "stderr.txt").write_text(finished.stderr)
        yield folder


@pytest.fixture
def copied(made, tmp_path, monkeypatch):
    """A copy of that directory, as the current one."""
    shutil.copytree(made, tmp_path / "copy")
    monkeypatch.chdir(tmp_path / "copy")
    return tmp_path / "copy"


@pytest.fixture
def no_runs(monkeypatch):
    """Makes every run fail the test's way: it must be read."""

    def refuse(*_, **__):
        raise AssertionError("a run was made")

    monkeypatch.setattr("cpdeform.run.resolve.ResolvedRun.run", refuse)


def test_rows_and_records(made):
    content = json.loads((made / "stdout.json").read_text())
    assert [(row["method"], row["seed"]) for row in content["rows"]] == [
        ("cpdeform", 0), ("cpdeform", 1), ("fixed", 0), ("fixed", 1),
    ]  # fmt: skip
    for row in content["rows"]:
        record = load_record(made / "out" / "shift" / f"{row['method']}-seed{row['seed']}")
        assert (row["task"], row["status"], row["stages"], row["stages_planned"]) == ("shift", "finished", 1, 1)
        assert record.run["names"]["placer"] == METHODS[row["method"]]["placer"]
        assert row["particles"] == record.task.scene.particle_count == 60
        assert row["gradient_evaluations"] == record.run["gradient_evaluations"] == 3
        assert 0.0 < row["w1_final"] < row["w1_initial"]
        floor = row["w1_floor"]
        assert row["ratio_above_floor"] == pytest.approx((row["w1_final"] - floor) / (row["w1_initial"] - floor))
        start, final = record.stages[0].state_before.position[0], record.stages[-1].state.position[0]
        begin, end, goal = (mass_grid(points.double(), record.task.scene) for points in (start, final, record.goal))
        way = soft_iou(goal, goal) - soft_iou(begin, goal)
        assert row["incremental_iou"] == pytest.approx(float((soft_iou(end, goal) - soft_iou(begin, goal)) / way), rel=1e-3)
        assert 0.01 < row["incremental_iou"] < 0.99
        assert row["w1_paper_final"] is None
        assert not row["reused"]
    assert content["sessions"][0]["machine"]["cores"] == available_cores()
    assert "4/4  shift, fixed, seed 1: finished" in (made / "stderr.txt").read_text()


def test_tables(made):
    assert [(row["task"], row["method"], row["seed"]) for row in table(made / "out")] == [
        ("shift", "cpdeform", "0"), ("shift", "cpdeform", "1"), ("shift", "fixed", "0"), ("shift", "fixed", "1"),
    ]  # fmt: skip
    text = (made / "out" / "table.md").read_text()
    lines = [line for line in text.splitlines() if line.startswith("| shift | ")]
    assert len(lines) == 5
    assert " ± " in lines[-1]
    assert lines[-1].endswith("| - |")
    for part in ("4 runs.", "ICLR 2022", "optimizer.iterations=3", "`cpdeform experiment multi-stage", "cores", "torch"):
        assert part in text
    assert str(made) not in text


def test_finished_records_are_read(copied, no_runs):
    finished = run_toy("--seeds", "0,1", "--out", "out", "--json", methods="cpdeform,fixed")
    assert finished.exit_code == 0, finished.output
    rows = json.loads(finished.stdout)["rows"]
    assert [row["reused"] for row in rows] == [True] * 4
    before = json.loads((copied / "stdout.json").read_text())["rows"]
    for row, old in zip(rows, before, strict=True):
        assert row | {"reused": False} == old


def test_another_configuration_runs_again(copied):
    assert run_toy("--out", "out").exit_code == 0
    assert [row["reused"] for row in table()] == ["True"]
    for change in (["--set", "optimizer.learning_rate=0.15"], ["--particles", "30"], ["--no-resume"]):
        assert run_toy("--out", "out", *change).exit_code == 0
        assert [row["reused"] for row in table()] == ["False"]
    record = load_record("out/shift/fixed-seed0")
    assert record.run["configuration"]["optimizer"]["learning_rate"] == 0.2
    moved = np.load("goal.npz")["position"] + [0.0, 0.01, 0.0]
    np.savez("goal.npz", position=moved)
    assert run_toy("--out", "out").exit_code == 0
    assert [row["reused"] for row in table()] == ["False"]


def test_interrupted_and_failed_records_run_again(copied):
    for number, status in enumerate(("running", "interrupted", "failed")):
        path = Path("out/shift/fixed-seed0/run.json")
        content = json.loads(path.read_text())
        path.write_text(json.dumps(content | {"status": status}))
        if number == 0:
            assert invoke("--no-run", "--out", "out", "--methods", "fixed", "--json").exit_code == 0
            assert [row["status"] for row in table()] == ["interrupted", "finished"]
        assert run_toy("--out", "out").exit_code == 0
        assert [(row["status"], row["reused"]) for row in table()] == [("finished", "False")]


def test_tables_of_records_alone(copied, no_runs):
    for name in ("table.md", "table.csv"):
        (copied / "out" / name).unlink()
    for path in copied.glob("out/*/*/evaluation.json"):
        path.unlink()
    finished = invoke("--no-run", "--out", "out")
    assert finished.exit_code == 0, finished.output
    assert (copied / "out" / "table.md").read_text() in finished.stdout
    assert len(table()) == 4
    assert "--iterations 3" in finished.stdout
    assert invoke("--no-run", "--out", "out", "--methods", "fixed", "--seeds", "1", "--tasks", "shift.yaml").exit_code == 0
    assert [(row["method"], row["seed"]) for row in table()] == [("fixed", "1")]
    assert invoke("--no-run", "--out", "elsewhere").exit_code == 2


def test_the_papers_metric_and_figures_that_are_kept(copied, no_runs, monkeypatch):
    pytest.importorskip("geomloss")
    assert "paper's W1 final" not in (copied / "out" / "table.md").read_text()
    arguments = ["--no-run", "--out", "out", "--methods", "fixed", "--seeds", "0"]
    assert invoke(*arguments, "--paper-metric").exit_code == 0
    monkeypatch.setattr("cpdeform.experiments.experiment_row.judge", None)
    assert invoke(*arguments).exit_code == 0
    (row,) = table()
    assert 0.0 < float(row["w1_paper_final"]) < float(row["w1_paper_initial"])
    assert 0.0 < float(row["w1_paper_floor"]) < float(row["w1_floor"])
    text = (copied / "out" / "table.md").read_text()
    assert "paper's W1 final" in text
    assert "GeomLoss's default schedule, blur 1e-05" in text
    # what cannot be judged is told, and the run stays a row
    (copied / "out" / "shift" / "fixed-seed0" / "evaluation.json").unlink()
    assert invoke(*arguments).exit_code == 1
    assert (table()[0]["status"], table()[0]["reason"][:11]) == ("finished", "No figures:")


def test_failures_are_rows(copied, monkeypatch):
    def fail(*_):
        raise RuntimeError("boom | in /home/somebody/clay.py")

    finished = run_toy("--set", "placer_options.candidates=2", "--out", "bad", methods="fixed,random")
    assert finished.exit_code == 0, finished.output
    assert [(row["method"], row["status"]) for row in table("bad")] == [("fixed", "failed"), ("random", "finished")]
    text = (copied / "bad" / "table.md").read_text()
    assert "- shift, fixed, seed 0: failed - option of placer fixed" in text
    # the same from the records alone
    assert invoke("--no-run", "--out", "bad").exit_code == 0
    assert [row["status"] for row in table("bad")] == ["failed", "finished"]
    monkeypatch.setattr("cpdeform_toy.simulator.SimulatorToy.rollout", fail)
    finished = run_toy("--out", "bad")
    assert finished.exit_code == 1
    assert [(row["status"], row["reason"]) for row in table("bad")] == [("failed", "RuntimeError: boom | in clay.py")]
    monkeypatch.undo()


def test_stages_without_a_plan_are_rows(copied):
    finished = run_toy("--set", "scene.tools.0.action_scale=[1e-30,1e-30,1e-30]", "--out", "still")
    assert finished.exit_code == 0, finished.output
    (row,) = table("still")
    assert (row["status"], row["stages"], row["stages_tried"]) == ("no_improvement", "0", "1")
    assert float(row["w1_final"]) == float(row["w1_initial"])
    assert "No plan lowered the loss any further" in (copied / "still" / "table.md").read_text()


def test_goals_from_a_directory(copied):
    goals = copied / "goals"
    goals.mkdir()
    finished = run_toy("--goals", goals, "--out", "goal")
    assert finished.exit_code == 1
    (row,) = table("goal")
    assert row["status"] == "failed"
    assert "no file shift.npz" in row["reason"]
    position = np.load("goal.npz")["position"][:40]
    np.savez(goals / "shift.npz", position=position)
    finished = run_toy("--goals", goals, "--out", "goal")
    assert finished.exit_code == 0, finished.output
    assert len(load_record("goal/shift/fixed-seed0").goal) == 40
    text = (copied / "goal" / "table.md").read_text()
    assert "goal=a given file" in text
    assert "another number of particles" in text
    assert str(copied) not in text


def test_particles_are_shared_out(copied):
    bodies = [
        {"kind": "sphere", "position": [0.3, 0.4, 0.4], "radius": 0.05, "particle_count": 20},
        {"kind": "sphere", "position": [0.5, 0.4, 0.4], "radius": 0.05, "particle_count": 40},
    ]
    setting = ["--set", f"scene.bodies={json.dumps(bodies)}"]
    assert run_toy(*setting, "--particles", "31", "--out", "fewer").exit_code == 0
    record = load_record("fewer/shift/fixed-seed0")
    assert [body.particle_count for body in record.task.scene.bodies] == [10, 21]
    assert len(record.goal) == 60
    assert run_toy(*setting, "--particles", "1", "--out", "fewer").exit_code == 1
    assert "at least 2" in table("fewer")[0]["reason"]


def test_equal_evaluations(copied):
    assert run_toy("--equal-evaluations", "--out", "out", methods="cpdeform,fixed").exit_code == 0
    assert [row["reused"] for row in table()] == ["True", "False"]
    optimizer = load_record("out/shift/fixed-seed0").run["configuration"]["optimizer"]
    assert (optimizer["iterations"], optimizer["patience"]) == (3, 3)
    assert run_toy("--equal-evaluations", "--out", "out", methods="fixed").exit_code == 2
    row = ExperimentRow(task="a", method="cpdeform", seed=0, status="finished", gradient_evaluations=101, stages_tried=2)
    assert evaluations_per_stage(row) == 51
    assert evaluations_per_stage(ExperimentRow(task="a", method="cpdeform", seed=0, status="failed")) is None


def test_means_beside_the_papers_figures():
    def row(method, seed, value, task="rope++", status="finished"):
        return ExperimentRow(task=task, method=method, seed=seed, status=status, w1_initial=0.05, w1_floor=0.004, w1_final=value)

    rows = [row("cpdeform", 0, 0.01), row("cpdeform", 1, 0.02), row("fixed", 0, 0.04), row("fixed", 1, None, status="failed")]
    rows += [row("cpdeform", 0, 0.03, task="star", status="no_improvement"), row("fixed", 0, None, "star", "failed")]
    lines = short_table(rows, "w1_final", paper=paper_figures("multi-stage")).splitlines()
    assert lines[0] == "| task | initial | floor | cpdeform | fixed | CPDeform in the paper |"
    assert lines[2] == "| rope++ | 0.0500 | 0.0040 | 0.0150 ± 0.0071 | 0.0400 (1 of 2) | 0.0052 |"
    assert lines[3] == "| star | 0.0500 | 0.0040 | 0.0300 | - (0 of 1) | - |"
    text = table_text("multi-stage", rows, sessions=[], planned=9)
    assert "6 of 9 runs." in text
    assert "GeomLoss's default schedule" in text
    assert "- star, cpdeform, seed 0: no improvement" not in text
    assert len(list(csv.DictReader(io.StringIO(csv_text(rows))))) == 6


def test_variants_share_a_line_of_the_single_stage_table():
    rows = [
        ExperimentRow(
            task=f"move-v{number}", method="cpdeform", seed=0, status="finished", incremental_iou=number / 4, w1_final=0.1
        )
        for number in (1, 2, 3)
    ]
    text = table_text("single-stage", rows, sessions=[], planned=3)
    assert "| move | 0.50 ± 0.25 | 0.90 |" in text
    assert "over variants and seeds" in text


def test_the_papers_figures_are_of_known_tasks():
    for name in ("multi-stage", "single-stage"):
        paper = paper_figures(name)
        assert set(paper.tasks) <= set(TASKS[name])
        assert hasattr(ExperimentRow, paper.figure)
    assert paper_figures("multi-stage").tasks == {"move++": 0.0127, "rope++": 0.0052, "writer++": 0.0067}


def test_variants_of_tasks():
    registry = load_registry()
    assert expand_tasks(["writer", "writer-v5", "a.yaml"], ["v1", "v2"], registry=registry) == (
        "writer-v1", "writer-v2", "writer-v5", "a.yaml",
    )  # fmt: skip
    assert expand_tasks(["writer"], [], registry=registry) == ("writer",)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("goal file /data/a b.npz: bad", "goal file a b.npz: bad"),
        ("'/home/somebody/x/y.npz', got 1/2", "'y.npz', got 1/2"),
        ("relative/path.npz and https://example.org/a", "relative/path.npz and https://example.org/a"),
    ],
)
def test_directories_are_left_out(text, expected):
    assert without_directories(text) == expected


def test_workers_that_were_killed_leave_a_word(copied, monkeypatch):
    """Nobody has done the run that is left: one that another command had done would be there."""
    monkeypatch.setattr("cpdeform.sweep.engines.local.EngineLocal.work", lambda *_: iter(()))
    finished = run_toy("--seeds", "0,2", "--out", "out", "--workers", "2")
    assert finished.exit_code == 2
    assert "the workers ended before" in finished.stderr
    assert "goes on where they were" in finished.stderr
