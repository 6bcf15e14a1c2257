"""`cpdeform experiment`: interruption and unusable options."""

from __future__ import annotations

import csv
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from cpdeform.cli.main import app
from cpdeform.run.record import load_record

QUICK = ["--backend", "toy", "--ot", "toy", "--iterations", "2", "--stages", "1"]


@pytest.fixture
def directory(tmp_path, monkeypatch, toy_distribution, toy_task_file):
    """The current directory, with a task file in it and the toy parts installed."""
    monkeypatch.syspath_prepend(str(toy_distribution))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def invoke(*arguments, name="multi-stage"):
    return CliRunner().invoke(app, ["experiment", name, *(str(argument) for argument in arguments)])


def test_interruption_leaves_the_table_and_the_next_call_goes_on(directory, monkeypatch):
    from cpdeform_toy.simulator import SimulatorToy

    rollout, out = SimulatorToy.rollout, Path("experiments/multi-stage")

    def interrupt(self, state, actions):
        if (out / "table.csv").exists():
            raise KeyboardInterrupt
        return rollout(self, state, actions)

    def rows():
        return [(row["seed"], row["status"], row["reused"]) for row in csv.DictReader((out / "table.csv").read_text().splitlines())]

    arguments = ["--tasks", "shift.yaml", "--methods", "fixed", "--seeds", "0,1,2", *QUICK]
    with monkeypatch.context() as patch:
        patch.setattr(SimulatorToy, "rollout", interrupt)
        finished = invoke(*arguments)
    assert finished.exit_code == 130
    assert "table.md holds the 1 runs that are done" in finished.stderr
    assert rows() == [("0", "finished", "False")]
    assert "1 of 3 runs." in (out / "table.md").read_text()
    assert load_record(out / "shift" / "fixed-seed1").status == "interrupted"
    finished = invoke(*arguments)
    assert finished.exit_code == 0, finished.output
    assert rows() == [("0", "finished", "True"), ("1", "finished", "False"), ("2", "finished", "False")]


@pytest.mark.parametrize(
    ("arguments", "messages"),
    [
        (["--tasks", "wrtier"], ['Did you mean "writer"']),
        (["--tasks", "shift.yaml,shift.yaml"], ["--tasks", "each once"]),
        (["--tasks", "shift.yaml,./shift.yaml"], ["both named shift"]),
        (["--methods", "fixd"], ["--methods", 'Did you mean "fixed"']),
        (["--seeds", "one"], ["--seeds", "whole numbers"]),
        (["--seeds", "-1"], ["--seeds: got -1"]),
        (["--iterations", "0"], ["--iterations: got 0"]),
        (["--particles", "0"], ["--particles: got 0"]),
        (["--goals", "nowhere"], ["--goals: got nowhere", "a directory"]),
        (["--backend", "tyo"], ['simulator: got "tyo"', 'Did you mean "toy"']),
        (["--ot", "tyo"], ['ot_solver: got "tyo"']),
        (["--device", "gpu"], ['--device: got "gpu"']),
        (["--set", "placer=toy"], ["--set", "Use --methods instead"]),
        (["--set", "optimizer.learning_rat=1"], ['Did you mean "learning_rate"']),
        (["--methods", "fixed", "--equal-evaluations"], ["--equal-evaluations", "methods cpdeform and fixed"]),
        (["--no-run"], ["--out", "without a run"]),
    ],
)
def test_unusable_options(directory, arguments, messages):
    finished = invoke(*([] if "--tasks" in arguments else ["--tasks", "shift.yaml"]), *arguments)
    assert finished.exit_code == 2, finished.output
    assert finished.stderr.count("cpdeform: error: ") == 1
    for message in messages:
        assert message in finished.stderr
    assert not (directory / "experiments").exists()


def test_unknown_variant(directory):
    finished = invoke("--tasks", "writer", "--variants", "v99", name="single-stage")
    assert finished.exit_code == 2
    assert "v99" in finished.stderr


def test_help_imports_nothing_heavy():
    script = (
        "import sys\n"
        "from cpdeform.cli.main import app\n"
        "try:\n"
        "    app(['experiment', 'multi-stage', '--help'])\n"
        "except SystemExit as end:\n"
        "    assert not end.code\n"
        "print('\\nHEAVY', sorted({'torch', 'warp', 'h5py', 'scipy', 'yaml'} & set(sys.modules)))\n"
    )
    finished = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert finished.stdout.splitlines()[-1] == "HEAVY []"
