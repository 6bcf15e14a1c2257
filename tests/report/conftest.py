from __future__ import annotations

import importlib.metadata

import pytest
from toy_fixtures import make_toy_task, toy_distribution, toy_entry_points, toy_task_file, write_toy_task

from cpdeform.core.plugins import load_registry
from cpdeform.planning.optimizer import TrajectoryOptimizer
from cpdeform.run.deform import deform
from cpdeform.run.record import RunRecorder
from cpdeform.testing.browser import Browser, find_browser

__all__ = ["make_toy_task", "toy_distribution", "toy_entry_points", "toy_task_file"]


def toy_registry():
    modules = {"toy": "cpdeform_toy.plugin", "strategies": "cpdeform.planning.plugin"}
    return load_registry([importlib.metadata.EntryPoint(name, module, "cpdeform") for name, module in modules.items()])


def make_record(directory, task_file, **options):
    parts = {"simulator": "toy", "ot_solver": "toy", "placer": "toy", **options}
    recorder = RunRecorder(directory)
    deform(str(task_file), registry=toy_registry(), optimizer=TrajectoryOptimizer(iterations=3), observers=[recorder], **parts)
    return recorder.directory


@pytest.fixture
def record(tmp_path, toy_task_file):
    """Makes records of runs of the toys."""
    return lambda **options: make_record(tmp_path / "run", toy_task_file, **options)


@pytest.fixture(scope="session")
def whole_record(tmp_path_factory):
    """A record of two stages, only to be read."""
    directory = tmp_path_factory.mktemp("whole")
    return make_record(directory / "run", write_toy_task(directory))


@pytest.fixture(scope="session")
def the_browser():
    if find_browser() is None:
        yield None
    else:
        with Browser(width=1200, height=860) as opened:
            yield opened


@pytest.fixture
def browser(the_browser):
    """A headless Chromium; tests that need one are skipped, saying so, where there is none."""
    if the_browser is None:
        pytest.skip("NO CHROMIUM: the page of a run is not looked at; install the package chromium")
    the_browser.open("about:blank")
    the_browser.events.clear()
    return the_browser
