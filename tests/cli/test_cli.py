from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from children import child_environment, interruptible_command, interrupts_ignored
from typer.testing import CliRunner

from cpdeform import __version__
from cpdeform.cli.main import app
from cpdeform.run.record import load_record

PARTS = ["--backend", "toy", "--ot", "toy", "--placer", "toy", "--iterations", "3"]
SECONDS_TO_WAIT = 60.0


@pytest.fixture
def directory(tmp_path, monkeypatch, toy_distribution, toy_task_file):
    """The current directory, with a task file in it and the toy parts installed."""
    monkeypatch.syspath_prepend(str(toy_distribution))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def invoke(*arguments):
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def run(*arguments, pictures=False):
    return invoke("run", "shift.yaml", *PARTS, *([] if pictures else ["--no-pictures"]), *arguments)


def files(directory: Path) -> set[str]:
    return {str(path.relative_to(directory)) for path in directory.rglob("*")}


def test_json(directory):
    result = run("--json", "--seed", 3, "--out", "run")
    assert result.exit_code == 0, result.output
    assert len(result.stdout.splitlines()) == 1
    summary = json.loads(result.stdout)
    expected = {"task": "shift", "backend": "toy", "ot": "toy", "placer": "toy", "seed": 3, "stages": 2, "out": "run"}
    assert expected.items() <= summary.items()
    assert {"loss_initial", "loss_final", "metric", "metric_value", "gradient_evaluations", "seconds", "status"} <= set(summary)
    assert (summary["metric"], summary["status"], summary["advice"]) == ("wasserstein", "finished", "")
    assert result.stderr == ""
    record = load_record("run")
    assert record.run["loss_final"] == summary["loss_final"] < summary["loss_initial"]
    configuration = record.run["configuration"]
    assert (configuration["seed"], configuration["optimizer"]["iterations"], configuration["task"]) == (3, 3, "shift.yaml")


def test_summary_and_default_directory(directory):
    result = run("--stages", 1)
    assert result.exit_code == 0, result.output
    made = list((directory / "runs").iterdir())
    assert [path.name.startswith("shift-2") for path in made] == [True]
    for text in ("shift: finished", "loss", "wasserstein", "1 stage,", f"runs/{made[0].name}"):
        assert text in result.stdout
    assert "stage 1: finished" in result.stderr


def test_settings_and_flags(directory):
    result = run("--json", "--out", "run", "--set", "seed=7", "--set", "optimizer.iterations=9", "--set", "placer_options.count=2")
    assert result.exit_code == 0, result.output
    configuration = load_record("run").run["configuration"]
    assert (configuration["seed"], configuration["optimizer"]["iterations"]) == (7, 3)
    assert len(load_record("run").stages[0].candidates) == 2


def test_task_by_setting(directory):
    result = invoke("run", *PARTS, "--json", "--no-pictures", "--out", "run", "--set", "task=shift.yaml")
    assert json.loads(result.stdout)["task"] == "shift"


@pytest.mark.parametrize(
    ("options", "status"),
    [
        (["--set", "placer_options.count=0"], "no_placement"),
        (["--set", "simulator_options.break_above=-2"], "non_finite"),
        (["--set", "placer_options.spacing=30"], "no_improvement"),
    ],
)
def test_runs_without_result(directory, options, status):
    result = run("--json", "--out", "run", *options)
    assert result.exit_code == 1
    summary = json.loads(result.stdout.splitlines()[-1])
    assert (summary["status"], summary["stages"]) == (status, 0)
    assert len(summary["advice"]) > 20
    assert load_record("run").status == status
    assert "advice" in run("--out", "other", *options).stdout


@pytest.mark.parametrize(
    ("arguments", "messages"),
    [
        (["--backend", "tyo"], ['simulator: got "tyo"', 'Did you mean "toy"']),
        (["--ot", "tyo"], ['ot_solver: got "tyo"', 'Did you mean "toy"']),
        (["--placer", "tyo"], ['placer: got "tyo"', 'Did you mean "toy"']),
        (["--backend", "toy-missing"], ['pip install "cpdeform-toy[more]"']),
        (["--ot", "toy-exact"], ["no transport priorities"]),
        (["--device", "gpu"], ["--device", "gpu"]),
        (["--device", "cuda"], ["not on cuda"]),
        (["--seed", "-1"], ["--seed: got -1"]),
        (["--stages", "0"], ["--stages: got 0, expected a value greater than or equal to 1."]),
        (["--iterations", "0"], ["--iterations: got 0"]),
        (["--set", "optimizer.learning_rat=1"], ["learning_rat", 'Did you mean "learning_rate"']),
        (["--set", "optimiser.learning_rate=1"], ['Did you mean "optimizer"']),
        (["--set", "optimizer.learning_rate=-1"], ["optimizer.learning_rate: got -1"]),
        (["--set", "seed"], ["--set", "key=value"]),
        (["--set", "placer_options.cuont=1"], ['Did you mean "count"']),
        (["--set", "ot_options.blur=wide"], ["options of ot_solver toy"]),
        (["--set", "simulator_options.batch_size=0"], ["batch_size: got 0"]),
        (["--set", "simulator_options.device=cuda"], ["Set device instead"]),
        (["--set", "scene.grid_sise=32"], ['Did you mean "grid_size"']),
        (["--set", "scene.bodies.3.radius=1"], ["bodies.3"]),
        (["--set", "scene.bodies.0.particle_count=0"], ["particle_count: got 0"]),
        (["--set", "scene.tools.0.position=[0.4,0.53,0.4]"], ["scene.tools.0", "deep inside the body"]),
        (["--out", "shift.yaml"], ["output directory shift.yaml", "a file"]),
        (["--out", "."], ["not empty", "--overwrite"]),
        (["--out", "shift.yaml/run"], ["cannot be written"]),
    ],
)
def test_unusable_options(directory, arguments, messages):
    before = files(directory)
    result = run(*arguments)
    assert result.exit_code == 2, result.output
    assert isinstance(result.exception, SystemExit)
    assert result.stderr.count("cpdeform: error: ") == 1
    assert len(result.stderr.splitlines()) == 1
    for message in messages:
        assert message in result.stderr
    assert result.stdout == ""
    assert files(directory) == before


@pytest.mark.parametrize(
    ("task", "messages"),
    [
        ("shiftt.yaml", ["no such file"]),
        ("wrtier", ['Did you mean "writer"']),
        ("writer-v99", ["variant of task writer", "v99"]),
        ("binary.yaml", ["binary.yaml"]),
        ("empty.yaml", ["empty.yaml"]),
        ("no_goal.yaml", ["no such file", "goal"]),
        ("bad_goal.yaml", ["unreadable"]),
    ],
)
def test_unusable_tasks(directory, task, messages):
    text = (directory / "shift.yaml").read_text()
    (directory / "binary.yaml").write_bytes(b"\xff\x00\xfe")
    (directory / "empty.yaml").write_text("")
    (directory / "no_goal.yaml").write_text(text.replace("goal.npz", "absent.npz"))
    (directory / "bad_goal.yaml").write_text(text.replace("goal.npz", "shift.yaml"))
    before = files(directory)
    result = invoke("run", task, *PARTS)
    assert result.exit_code == 2, result.output
    assert len(result.stderr.splitlines()) == 1
    for message in messages:
        assert message in result.stderr
    assert files(directory) == before


@pytest.mark.parametrize("arguments", [["run", "--stages", "two"], ["run", "--no-such-option"], ["sculpt"], ["run", "a", "b"]])
def test_usage_errors(directory, arguments):
    result = invoke(*arguments)
    assert result.exit_code == 2
    assert "Traceback" not in result.output


def test_overwrite(directory):
    assert run("--out", "run").exit_code == 0
    (directory / "run" / "notes.txt").write_text("mine")
    before = files(directory)
    assert run("--out", "run").exit_code == 2
    assert run("--out", "run", "--overwrite", "--stages", "nine").exit_code == 2
    assert run("--out", "run", "--overwrite", "--stages", "0").exit_code == 2
    assert files(directory) == before
    assert run("--out", "run", "--overwrite", "--stages", "1").exit_code == 0
    assert {"run/notes.txt", "run/stage-000.h5"} <= files(directory)
    assert "run/stage-001.h5" not in files(directory)


def test_pictures(directory, monkeypatch):
    result = run("--out", "run", "--stages", "1", pictures=True)
    assert result.exit_code == 0, result.output
    assert "picture  run/picture.png" in result.stdout
    assert (directory / "run" / "picture.png").stat().st_size > 10_000

    def fail(record):
        raise RuntimeError("no font")

    monkeypatch.setattr("cpdeform.report.draw_run", fail)
    result = run("--out", "other", "--stages", "1", pictures=True)
    assert result.exit_code == 0
    assert "no pictures: RuntimeError: no font" in result.stderr


@pytest.mark.filterwarnings("always::RuntimeWarning")
def test_failing_observers_are_told_and_do_not_stop_the_run(directory, monkeypatch):
    import cpdeform_toy.plugin

    from cpdeform.core.hookspecs import hookimpl

    def fail(result):
        raise RuntimeError("boom")

    monkeypatch.setattr(cpdeform_toy.plugin, "cpdeform_stage_finished", hookimpl(fail), raising=False)
    result = run("--json", "--out", "run", "--stages", "1")
    assert result.exit_code == 0
    assert "cpdeform: warning: plugin cpdeform-toy 0.1:toy: cpdeform_stage_finished failed with RuntimeError: boom" in result.stderr


def test_tasks(directory):
    listed = {entry["name"]: entry for entry in json.loads(invoke("tasks", "--json").stdout)}
    assert {"writer", "toy"} <= set(listed)
    assert set(listed["writer"]["variants"]) == {"v1", "v2", "v3", "v4", "v5"}
    assert "no such file" in listed["toy"]["problem"]
    assert "writer" in invoke("tasks").stdout


def test_plugins(directory, monkeypatch):
    import cpdeform_toy.plugin

    from cpdeform.core.hookspecs import hookimpl

    content = json.loads(invoke("plugins", "--json").stdout)
    parts = {(part["kind"], part["name"]): part for part in content["plugins"]}
    toy = parts["simulator", "toy"]
    assert (toy["available"], toy["distribution"], toy["summary"]) == (True, "cpdeform-toy 0.1", "shifts the body")
    assert 'pip install "cpdeform-toy[more]"' in parts["simulator", "toy-missing"]["reason"]
    assert not parts["task", "toy"]["available"]
    monkeypatch.setattr(cpdeform_toy.plugin, "cpdeform_placers", hookimpl(lambda: ["wrong"]))
    result = invoke("plugins")
    assert result.exit_code == 0
    assert "failed to load: toy [cpdeform-toy 0.1]: PluginError" in result.stdout


def test_version():
    assert invoke("--version").stdout.strip() == f"cpdeform {__version__}"


def test_the_package_runs_as_a_module():
    finished = subprocess.run([sys.executable, "-m", "cpdeform", "--version"], capture_output=True, text=True, check=True)
    assert finished.stdout.strip() == f"cpdeform {__version__}"


@pytest.mark.parametrize("arguments", [["--help"], ["run", "--help"], ["--version"], ["tasks"]])
def test_heavy_modules_are_not_imported(arguments):
    script = (
        "import sys\n"
        "from cpdeform.cli.main import app\n"
        "try:\n"
        f"    app({arguments!r})\n"
        "except SystemExit as end:\n"
        "    assert not end.code\n"
        "heavy = {'torch', 'warp', 'taichi', 'ot', 'geomloss', 'matplotlib', 'h5py', 'imageio', 'scipy'}\n"
        "print('\\nHEAVY', sorted(heavy & set(sys.modules)))\n"
    )
    finished = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert finished.stdout.splitlines()[-1] == "HEAVY []"


def test_interruption(directory, toy_distribution):
    """Control-C in a run: exit code 130, and a message where the record is."""
    environment = child_environment(toy_distribution)
    arguments = ["run", "shift.yaml", *PARTS[:-1], "100000", "--out", "run", "--set", "simulator_options.delay=0.01"]
    arguments += ["--set", "optimizer.patience=100000"]
    with interrupts_ignored():
        process = subprocess.Popen(
            interruptible_command(arguments),
            env=environment, cwd=directory, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
    metrics, limit = directory / "run" / "metrics.jsonl", time.monotonic() + SECONDS_TO_WAIT
    while not (metrics.exists() and metrics.stat().st_size) and time.monotonic() < limit and process.poll() is None:
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=SECONDS_TO_WAIT)
    assert process.returncode == 130, errors
    assert "interrupted; the finished stages are recorded in run" in errors
    assert "Traceback" not in errors
    assert load_record(directory / "run").status == "interrupted"
