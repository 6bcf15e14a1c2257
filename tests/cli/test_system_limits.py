"""Limits of the system are one line that says what to do, and exit code 2."""

from __future__ import annotations

import errno
import os
from pathlib import Path

import pytest
from typer.testing import CliRunner

from cpdeform.cli.main import app
from cpdeform.cli.system_limits import REMEDIES, system_limit


def test_a_name_that_is_too_long_is_refused(tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["run", "writer", "--backend", "warp", "--out", str(tmp_path / ("x" * 300))])
    assert result.exit_code == 2
    (line,) = result.stderr.splitlines()
    assert line.startswith("cpdeform: error: output directory")
    assert "File name too long" in line


@pytest.mark.parametrize("number", REMEDIES)
def test_limits_are_told_in_a_line(number: int, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise OSError(number, os.strerror(number), "some/file")

    monkeypatch.setattr("cpdeform.core.task.load_task", fail)
    result = CliRunner().invoke(app, ["task", "check", "writer"])
    assert result.exit_code == 2
    assert result.stderr == f"cpdeform: error: some/file: {os.strerror(number).lower()}. {REMEDIES[number]}\n"


def test_other_errors_keep_their_trace() -> None:
    assert system_limit(OSError(errno.EBADF, os.strerror(errno.EBADF))) is None
