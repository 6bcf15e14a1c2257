"""Nothing is ever written outside of the place that was asked for, whatever a task is called and whatever lies there."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

from cpdeform.cli.main import app
from cpdeform.core.errors import InputError
from cpdeform.core.task import load_task
from cpdeform.run.deform import deform
from cpdeform.run.record import load_record

PARTS = ["--backend", "toy", "--ot", "toy"]
NAMES = ["../../escaped/x", "/tmp/cpdeform-escaped", "..", ".", "a\\b", "a\nb", "", "a/../../b"]


@pytest.fixture
def inside(tmp_path, monkeypatch, toy_distribution, toy_task_file):
    """The current directory, two below one that is watched."""
    monkeypatch.syspath_prepend(str(toy_distribution))
    place = tmp_path / "watched" / "deep" / "inside"
    place.mkdir(parents=True)
    monkeypatch.chdir(place)
    return place


@pytest.fixture
def named(toy_task_file):
    """Gives the toy task another name."""

    def write(name: str) -> str:
        content = yaml.safe_load(toy_task_file.read_text())
        toy_task_file.write_text(yaml.safe_dump({**content, "name": name}))
        return str(toy_task_file)

    return write


def invoke(*arguments):
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def everything(directory: Path) -> set[str]:
    """All that lies below a directory; links are not followed."""
    return {str(path.relative_to(directory)) for path in directory.rglob("*")}


def outside(inside: Path) -> set[str]:
    watched = inside.parents[1]
    return {name for name in everything(watched) if not name.startswith("deep/inside")}


@pytest.mark.parametrize("name", NAMES)
def test_names_that_lead_elsewhere(inside, named, tmp_path, name):
    task = named(name)
    before = everything(tmp_path)
    commands = (
        ["run", task, *PARTS, "--placer", "toy", "--no-pictures"],
        ["experiment", "multi-stage", "--tasks", task, *PARTS, "--methods", "fixed", "--seeds", "0", "--stages", "1"],
        ["task", "generate", task, "--seed", "1", "--out", "goal.npz"],
    )
    for command in commands:
        result = invoke(*command)
        assert result.exit_code == 2, (command, result.output)
        assert "name" in result.stderr
    with pytest.raises(InputError, match="name"):
        deform(task, simulator="toy", ot_solver="toy", placer="toy")
    assert everything(tmp_path) == before


def test_a_name_with_dots_and_blanks_stays_inside(inside, named, tmp_path):
    task = named(".. x ..")
    before = everything(tmp_path)
    run = invoke("run", task, *PARTS, "--placer", "toy", "--iterations", "2", "--stages", "1", "--no-pictures")
    assert run.exit_code == 0, run.output
    experiment = ["--tasks", task, *PARTS, "--methods", "fixed", "--seeds", "0", "--stages", "1", "--iterations", "2"]
    assert invoke("experiment", "multi-stage", *experiment).exit_code == 0
    made = everything(tmp_path) - before
    assert made
    assert all(name.startswith("watched/deep/inside/") for name in made), made


def test_grids_with_names_that_lead_elsewhere(inside, tmp_path):
    """The name of a file in an archive names the goal that is made of it."""
    np.savez(tmp_path / "grids.npz", **{"../../escaped/x": np.ones((64, 64, 64))})
    before = everything(tmp_path)
    result = invoke("task", "import-grid", tmp_path / "grids.npz", "--all", "--out", "goals")
    assert result.exit_code == 2, result.output
    assert all(name.startswith("watched/deep/inside/") for name in everything(tmp_path) - before)


def test_links_in_the_directory_are_not_followed(inside, toy_task_file):
    """Links that bear the names of a record's files, left by somebody else: they are replaced, not written through."""
    out = inside / "run"
    out.mkdir()
    victim = inside.parent / "victim"
    victim.write_text("mine")
    names = ["run.json", "metrics.jsonl", "goal.h5", "stage-000.h5"]
    names += [".run.tmp.json", ".goal.tmp.h5", ".stage-000.tmp.h5", ".run.lock"]
    for number, name in enumerate(names):
        (out / name).symlink_to(victim if number % 2 else inside.parent / "fresh")
    before = outside(inside)
    options = [*PARTS, "--placer", "toy", "--iterations", "2", "--stages", "1", "--no-pictures", "--out", "run"]
    result = invoke("run", toy_task_file, *options, "--overwrite")
    assert outside(inside) == before
    assert victim.read_text() == "mine"
    # The lock's file is not the record's to replace.
    assert result.exit_code == 2, result.output
    (out / ".run.lock").unlink()
    result = invoke("run", toy_task_file, *options, "--overwrite")
    assert result.exit_code == 0, result.output
    assert outside(inside) == before
    assert victim.read_text() == "mine"
    assert load_record(out).status == "finished"


def test_a_link_that_leads_to_itself(inside, toy_task_file, tmp_path):
    Path("loop").symlink_to("loop")
    before = everything(tmp_path)
    commands = (
        ["run", toy_task_file, *PARTS, "--placer", "toy", "--no-pictures", "--out", "loop"],
        ["run", toy_task_file, *PARTS, "--placer", "toy", "--no-pictures", "--out", "loop/run"],
        ["task", "generate", "writer", "--seed", "1", "--out", "loop/goal.npz"],
        ["evaluate", "loop"],
    )
    for command in commands:
        result = invoke(*command)
        assert result.exit_code == 2, (command, result.output, result.exception)
        assert len(result.stderr.splitlines()) == 1
    result = invoke("experiment", "multi-stage", "--tasks", toy_task_file, *PARTS, "--seeds", "0", "--out", "loop")
    assert result.exit_code == 2, (result.output, result.exception)
    made = deform(load_task(toy_task_file), simulator="toy", ot_solver="toy", placer="toy", stages=1)
    with pytest.raises(InputError, match="output directory loop"):
        made.save("loop")
    assert everything(tmp_path) == before


def test_evaluating_writes_nothing(inside, toy_task_file, tmp_path):
    options = [*PARTS, "--placer", "toy", "--iterations", "2", "--stages", "1", "--no-pictures", "--out", "run"]
    assert invoke("run", toy_task_file, *options).exit_code == 0
    before = everything(tmp_path)
    invoke("evaluate", "run")
    assert everything(tmp_path) == before
