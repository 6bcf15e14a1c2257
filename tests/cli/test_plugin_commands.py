"""Commands of plugins: listed, imported on use, called as the built-in ones are."""

from __future__ import annotations

import subprocess
import sys

import pytest
from typer.testing import CliRunner

from cpdeform.cli.main import app


@pytest.fixture
def toys(monkeypatch, toy_distribution):
    monkeypatch.syspath_prepend(str(toy_distribution))


def invoke(*arguments):
    return CliRunner().invoke(app, list(arguments))


def test_a_plugins_command_is_called(toys):
    result = invoke("toy-greet", "clay", "--times", "2")
    assert (result.exit_code, result.stdout) == (0, "hello clay hello clay\n")


def test_its_own_help_tells_its_parameters(toys):
    for flag in ("--help", "-h"):
        result = invoke("toy-greet", flag)
        assert result.exit_code == 0
        assert "several times if need be" in result.stdout
        assert "--times" in result.stdout


def test_it_is_listed_without_being_imported(toys, monkeypatch):
    monkeypatch.delitem(sys.modules, "cpdeform_toy.commands", raising=False)
    result = invoke("--help")
    assert "toy-greet" in result.stdout
    assert "Greet somebody." in result.stdout
    assert "cpdeform_toy.commands" not in sys.modules


def test_errors_are_told_in_a_line(toys):
    result = invoke("toy-greet", "--times", "0")
    assert result.exit_code == 2
    assert result.stderr == "cpdeform: error: --times: got 0, expected at least 1.\n"
    result = invoke("toy-lost")
    assert result.exit_code == 2
    assert 'has no attribute "lost"' in result.stderr


def test_no_plugin_takes_the_place_of_a_built_in_command(toys):
    assert "writer" in invoke("tasks").stdout
    assert "Not the built-in one" not in invoke("--help").stdout


def test_an_unknown_command_is_told(toys):
    result = invoke("toy-greed")
    assert result.exit_code == 2
    assert "No such command" in result.stderr


def test_help_imports_nothing_heavy():
    script = (
        "import sys\n"
        "from cpdeform.cli.main import app\n"
        "try:\n"
        "    app(['--help'])\n"
        "except SystemExit as end:\n"
        "    assert not end.code\n"
        "print('\\nHEAVY', sorted({'torch', 'warp', 'scipy', 'gymnasium', 'stable_baselines3'} & set(sys.modules)))\n"
    )
    finished = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert finished.stdout.splitlines()[-1] == "HEAVY []"
