"""What a newcomer stumbled over."""

from __future__ import annotations

import json
import shlex
import subprocess
import sys
import time

import pytest
import torch
from children import child_environment
from typer.testing import CliRunner

from cpdeform.cli.bench_output import _print_table
from cpdeform.cli.doctor import doctor
from cpdeform.cli.main import app
from cpdeform.cli.plugins import plugins
from cpdeform.core.errors import PluginError
from cpdeform.core.plugins import load_registry
from cpdeform.core.state import State
from cpdeform.run.command import command_of
from cpdeform.run.configuration import RunConfiguration
from cpdeform.run.record import load_record
from cpdeform.run.resolve import PartObjects, _chosen_parts

PARTS = ["--backend", "toy", "--ot", "toy", "--placer", "toy", "--iterations", "3", "--no-pictures"]


@pytest.fixture
def directory(tmp_path, monkeypatch, toy_distribution, toy_task_file):
    """The current directory, with a task file in it and the toy parts installed."""
    monkeypatch.syspath_prepend(str(toy_distribution))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def invoke(*arguments):
    return CliRunner().invoke(app, [str(argument) for argument in arguments], env={"COLUMNS": "200"})


@pytest.mark.parametrize("setting", ["algorithm=paper", "optimizer.schedule=paper"])
def test_settings_of_earlier_versions_are_refused_with_what_took_their_place(directory, setting):
    result = invoke("run", "shift.yaml", *PARTS, "--set", setting)
    assert result.exit_code == 2
    assert setting in result.stderr
    assert ("--strategy paper" in result.stderr) == ("algorithm" in setting)
    assert ("optimizer.pruner" in result.stderr) == ("schedule" in setting)


@pytest.mark.parametrize("command", ["run", "bench simulators", "bench ot", "bench run", "evaluate", "experiment", "check golden"])
def test_help_tells_the_defaults(command):
    """Rich takes what stands in brackets for markup, and leaves it out."""
    result = invoke(*shlex.split(command), "--help")
    assert result.exit_code == 0
    text = " ".join(result.stdout.split())
    if command == "run":
        assert "Defaults to writer" in text
        assert text.count("Defaults to") >= 10
    assert "  ." not in result.stdout


def test_paragraphs_of_help_are_broken_where_the_terminal_ends():
    result = CliRunner().invoke(app, ["task", "new", "--help"], env={"COLUMNS": "100"})
    (line,) = (line for line in result.stdout.splitlines() if line.strip().startswith("Meshes are repaired"))
    assert len(line.rstrip()) > 85
    examples = [line.strip() for line in CliRunner().invoke(app, ["verify", "--help"]).stdout.splitlines()]
    assert examples[examples.index("Examples:") + 1] == "cpdeform verify runs/star"


@pytest.mark.parametrize("arguments", [["writr"], ["writer", "--backend", "wrap"], ["writer", "--set", "algorithm=paper"]])
def test_typos_are_answered_before_torch_is_imported(arguments):
    script = (
        "import sys\nfrom cpdeform.cli.main import app\ntry:\n    app(sys.argv[1:])\nfinally:\n    print('torch' in sys.modules)"
    )
    done = subprocess.run(
        [sys.executable, "-c", script, "run", *arguments], capture_output=True, text=True, env=child_environment(), check=False
    )
    assert done.returncode == 2
    assert done.stdout.strip() == "False"
    assert "cpdeform: error" in done.stderr


def test_all_that_is_missing_is_told_at_once():
    registry = load_registry([])
    with pytest.raises(PluginError) as caught:
        _chosen_parts(RunConfiguration(), PartObjects(), registry=registry)
    assert all(text in str(caught.value) for text in ("simulator", "ot_solver", 'pip install "cpdeform[all]"'))


def test_quiet(directory):
    result = invoke("run", "shift.yaml", *PARTS, "--quiet", "--out", "run")
    assert (result.exit_code, result.stdout, result.stderr) == (0, "", "")
    assert load_record("run").status == "finished"
    wrong = invoke("run", "shift.yaml", *PARTS, "--quiet", "--out", "run")
    assert wrong.exit_code == 2
    assert "not empty" in wrong.stderr


def test_progress_tells_parts_and_batches(directory, monkeypatch):
    monkeypatch.setattr("cpdeform.cli.progress.SECONDS_BETWEEN_LINES", 0.0)
    lines = invoke("run", "shift.yaml", *PARTS, "--out", "run").stderr.splitlines()
    assert lines[0].startswith("estimate: ")
    assert lines[1] == "stage 1: transport"
    assert sum(line.startswith("stage 1, batch 1, iteration") for line in lines) == 3
    assert "stage 2: transport" in lines
    assert any(line.startswith("stage 2, batch 1, iteration 1/3") for line in lines)


def test_metrics_have_time_and_gradient_norm(directory):
    begun = time.time()
    invoke("run", "shift.yaml", *PARTS, "--out", "run")
    lines = load_record("run").metrics
    times = [line["time"] for line in lines if line["kind"] == "iteration"]
    assert begun - 1.0 < times[0] <= times[-1] < time.time() + 1.0
    assert times == sorted(times)
    norms = [norm for line in lines if line["kind"] == "iteration" for norm in line["gradient_norm"]]
    assert norms
    assert all(norm is None or norm > 0.0 for norm in norms)


def test_tables_fit_a_narrow_terminal(monkeypatch, capsys):
    rows = [{"error": None, "name": "warp", **{f"figure {number}": 1.0 for number in range(12)}}]
    columns = {key: (key, "" if key == "name" else ".3g") for key in rows[0] if key != "error"}
    monkeypatch.setattr("sys.stdout.isatty", lambda: True, raising=False)
    monkeypatch.setenv("COLUMNS", "80")
    _print_table(rows, columns)
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 80
    assert any(line.split() == ["figure", "11", "1"] for line in lines)


@pytest.mark.parametrize("command", [plugins, doctor])
def test_lists_fit_a_narrow_terminal(command, monkeypatch, capsys):
    command()
    whole = capsys.readouterr().out
    monkeypatch.setattr("sys.stdout.isatty", lambda: True, raising=False)
    monkeypatch.setenv("COLUMNS", "80")
    command()
    narrow = capsys.readouterr().out
    assert max(map(len, whole.splitlines())) > 80
    # A path without a space stays in one piece.
    assert all(len(line) <= 80 or " " not in line.strip() for line in narrow.splitlines())
    assert narrow.split() == whole.split()


def test_plugins_do_not_repeat_the_tasks(directory):
    text = invoke("plugins").stdout
    assert "writer" not in text
    assert "cpdeform tasks" in text


def test_a_state_is_saved_and_loaded_safely(directory):
    invoke("run", "shift.yaml", *PARTS, "--out", "run")
    state = load_record("run").state
    torch.save(state.tensors(), "state.pt")
    back = State(**torch.load("state.pt", weights_only=True))
    for name, tensor in state.tensors().items():
        torch.testing.assert_close(getattr(back, name), tensor)


def test_the_command_of_a_record_repeats_its_run(directory):
    """What the record says to type gives the same configuration again; what the strategy set is not repeated in it."""
    options = ["--seed", "4", "--stages", "1", "--set", "optimizer.learning_rate=0.07", "--set", "placer_options={}"]
    assert invoke("run", "shift.yaml", *PARTS, *options, "--out", "run").exit_code == 0
    record = load_record("run")
    command = command_of(record)
    words = shlex.split(command)
    assert words[:3] == ["cpdeform", "run", "shift.yaml"]
    assert "optimizer.learning_rate=0.07" in words
    assert not any(word.startswith("optimizer.tolerance") for word in words)
    again = invoke(*words[1:], "--dry-run", "--json")
    assert again.exit_code == 0, again.output
    assert json.loads(again.stdout)["configuration"] == record.run["configuration"]
    rest = invoke("run", "--resume", "run", "--stages", "1", "--out", "rest", "--no-pictures")
    assert rest.exit_code == 0, rest.output
    assert shlex.split(command_of(load_record("rest")))[:4] == ["cpdeform", "run", "--resume", "run"]


def test_origins_are_recorded(directory):
    invoke("run", "shift.yaml", *PARTS, "--seed", "4", "--out", "run")
    origins = load_record("run").run["origins"]
    assert origins["seed"] == origins["optimizer.iterations"] == origins["backend"] == "given"
    assert origins["device"] == "default"
    assert origins["optimizer.learning_rate"] in ("default", "strategy")
