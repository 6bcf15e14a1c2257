from __future__ import annotations

import os
import sys

import pytest

from cpdeform.core.errors import InputError
from cpdeform.experiments.worker import WorkerError, call_in_worker

HERE = os.path.dirname(__file__)


def answer(request):
    sys.stdout.write("a library greets\n")
    return {"twice": 2 * request["number"], "variable": os.environ.get("CPDEFORM_TEST"), "process": os.getpid()}


def refuse(request):
    raise InputError("number", came="3", expected="4")


def stumble(request):
    return {"quotient": 1 / request["number"]}


def swell(request):
    raise MemoryError


def sleep(request):
    import time

    time.sleep(60)


def leave(request):
    sys.stderr.write("no licence\n")
    os._exit(3)


def crash(request):
    os.kill(os.getpid(), request["signal"])


@pytest.fixture(autouse=True)
def importable(monkeypatch):
    monkeypatch.setenv("PYTHONPATH", HERE)


def test_an_answer_comes_from_another_process():
    found = call_in_worker("test_worker:answer", {"number": 3}, environment={"CPDEFORM_TEST": "here"})
    assert (found["twice"], found["variable"]) == (6, "here")
    assert found["process"] != os.getpid()


@pytest.mark.parametrize(
    ("function", "request_", "text"),
    [
        ("refuse", {}, "number: got 3, expected 4."),
        ("stumble", {"number": 0}, "ZeroDivisionError"),
        ("swell", {}, "out of memory"),
        ("absent", {}, "AttributeError"),
        ("leave", {}, "exit code 3: no licence"),
        ("crash", {"signal": 11}, "killed by SIGSEGV"),
        ("crash", {"signal": 9}, r"killed by SIGKILL \(out of memory\?\)"),
    ],
)
def test_whatever_breaks_is_told_in_a_line(function, request_, text):
    with pytest.raises(WorkerError, match=text) as caught:
        call_in_worker(f"test_worker:{function}", request_)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) <= 200


def test_time_is_bounded():
    with pytest.raises(WorkerError, match=r"^timeout$"):
        call_in_worker("test_worker:sleep", {}, timeout=0.5)
