"""Control-C, however often it is pressed, SIGTERM and the end of the terminal: the record is complete, and nothing is lost."""

from __future__ import annotations

import fcntl
import os
import pty
import signal
import subprocess
import termios
import time
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from children import child_environment, interruptible_command, interrupts_ignored
from typer.testing import CliRunner

from cpdeform.cli.interruption import BURST, Interruption, exit_code, interruptible
from cpdeform.cli.main import app
from cpdeform.run.record import load_record

ENDLESS = ["--backend", "toy", "--ot", "toy", "--placer", "toy", "--iterations", "100000", "--stages", "1", "--no-pictures"]
ENDLESS += ["--set", "simulator_options.delay=0.01", "--set", "optimizer.patience=100000", "--out", "run"]
SECONDS_TO_WAIT = 180.0


def wait_for(condition: Callable[[], bool], process: subprocess.Popen[str]) -> None:
    limit = time.monotonic() + SECONDS_TO_WAIT
    while not condition():
        assert process.poll() is None
        assert time.monotonic() < limit
        time.sleep(0.01)


def start(directory: Path, site: Path, **options: object) -> subprocess.Popen[str]:
    """A run without end, in its first and only stage after some iterations."""
    command = interruptible_command(["run", "shift.yaml", *ENDLESS])
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    settings = {"env": child_environment(site), "cwd": directory, "text": True, **pipes}
    with interrupts_ignored():
        process = subprocess.Popen(command, **{**settings, **options})
    metrics = directory / "run" / "metrics.jsonl"
    try:
        wait_for(lambda: metrics.exists() and metrics.read_text().count("\n") > 5, process)
    except BaseException:
        process.kill()
        process.communicate()
        raise
    return process


def assert_recorded(directory: Path) -> None:
    """The stage that was interrupted is in the record with a plan that gains something."""
    record = load_record(directory / "run")
    assert record.status == "interrupted"
    assert record.run["advice"]
    (stage,) = record.stages
    assert stage.status.value == "interrupted"
    assert stage.loss < stage.loss_before
    assert not torch.equal(stage.state.position, stage.state_before.position)
    best = min(min(line["best_loss"]) for line in record.metrics if line["kind"] == "iteration")
    assert stage.loss == pytest.approx(best, rel=1e-6)


@pytest.mark.parametrize(("name", "times", "code"), [("SIGINT", 5, 130), ("SIGTERM", 2, 143)])
def test_signals_are_one_interruption(tmp_path, toy_distribution, toy_task_file, monkeypatch, name, times, code):
    process = start(tmp_path, toy_distribution)
    for _ in range(times):
        process.send_signal(getattr(signal, name))
        time.sleep(0.01)
    _, errors = process.communicate(timeout=SECONDS_TO_WAIT)
    assert process.returncode == code, errors
    assert "Traceback" not in errors
    assert [line for line in errors.splitlines() if line.startswith("cpdeform: interrupted")] == errors.splitlines()[-1:]
    assert "best plan so far" in errors
    assert_recorded(tmp_path)
    if name == "SIGINT":
        monkeypatch.syspath_prepend(str(toy_distribution))
        monkeypatch.chdir(tmp_path)
        options = ["--iterations", "3", "--out", "rest", "--no-pictures"]
        finished = CliRunner().invoke(app, ["run", "--resume", "run", *options])
        assert finished.exit_code == 0, finished.output
        half, rest = load_record("run"), load_record("rest")
        assert [stage.index for stage in rest.stages] == [1]
        assert torch.equal(rest.stages[0].state_before.position, half.state.position)


def test_a_terminal_that_is_closed(tmp_path, toy_distribution, toy_task_file):
    """The kernel sends SIGHUP, and whatever is written to the terminal fails from then on."""
    terminal, end = pty.openpty()

    def lead() -> None:
        os.setsid()
        fcntl.ioctl(0, termios.TIOCSCTTY, 0)

    process = start(tmp_path, toy_distribution, stdin=end, stdout=end, stderr=end, preexec_fn=lead)
    os.close(end)
    os.close(terminal)
    assert process.wait(timeout=SECONDS_TO_WAIT) == 129
    assert_recorded(tmp_path)


def test_a_burst_is_one_interruption_and_a_later_signal_another(monkeypatch):
    now = [100.0]
    monkeypatch.setattr("cpdeform.cli.interruption.time.monotonic", lambda: now[0])
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with interruptible():
            with pytest.raises(KeyboardInterrupt) as caught:
                signal.raise_signal(signal.SIGTERM)
            assert exit_code(caught.value) == 143
            # The same burst, and a signal that was ignored before, as nohup does.
            signal.raise_signal(signal.SIGINT)
            signal.raise_signal(signal.SIGHUP)
            now[0] += BURST
            with pytest.raises(Interruption):
                signal.raise_signal(signal.SIGINT)
        with interruptible():
            pass
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def test_handlers_are_restored():
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    before = [signal.getsignal(number) for number in numbers]
    with interruptible():
        assert [signal.getsignal(number) for number in numbers] != before
    assert [signal.getsignal(number) for number in numbers] == before


def test_an_interruption_that_python_ignores_comes_again():
    class Object:
        def __del__(self) -> None:
            signal.raise_signal(signal.SIGTERM)

    def drop_and_wait() -> None:
        with interruptible():
            item = Object()
            del item
            time.sleep(5.0)

    before = signal.getsignal(signal.SIGTERM)
    try:
        with pytest.raises(Interruption):
            drop_and_wait()
    finally:
        signal.signal(signal.SIGTERM, before)
