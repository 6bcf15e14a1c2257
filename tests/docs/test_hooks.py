"""The package of docs/hooks.md, written to a folder and installed as far as entry points go, does what the page says."""

from __future__ import annotations

import importlib
import logging
import runpy
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from doc_blocks import DOCS, blocks
from typer.testing import CliRunner

from cpdeform import Registry, deform, load_registry, load_task
from cpdeform.cli.main import app
from cpdeform.core.hookspecs import hookimpl
from cpdeform.core.plugins import KINDS
from cpdeform.testing.ot import check_ot_solver
from cpdeform.testing.placer import check_placer
from cpdeform.testing.simulator import check_simulator

PAGE = DOCS / "hooks.md"
CONTRACT = (
    "shapes",
    "not modified",
    "twice",
    "loop over worlds",
    "a copy",
    "rolled out",
    "gradient of actions",
    "bad arguments",
    "refused",
)
"""The checks of a simulator that say nothing about physics."""


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A folder on sys.path with the package and its metadata."""
    folder = tmp_path_factory.mktemp("site")
    for block in blocks(PAGE, "python", "yaml", "toml"):
        name, _, text = block.text.partition("\n")
        path = folder / name.removeprefix("# ")
        path.parent.mkdir(exist_ok=True)
        path.write_text(text, encoding="utf-8")
    (folder / "my_package" / "__init__.py").write_text("")
    project = tomllib.loads((folder / "pyproject.toml").read_text())["project"]
    metadata = folder / f"my_package-{project['version']}.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n")
    points = [f"{name} = {target}" for name, target in project["entry-points"]["cpdeform"].items()]
    (metadata / "entry_points.txt").write_text("\n".join(["[cpdeform]", *points]))
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(folder))
        patch.chdir(folder)
        importlib.invalidate_caches()
        runpy.run_path("make_nudge.py")
        runpy.run_path("make_sweep.py")
        yield folder


@pytest.fixture(scope="module")
def registry(site: Path) -> Registry:
    return load_registry()


def test_every_hook_has_a_section() -> None:
    text = PAGE.read_text()
    hooks = [*KINDS.values(), "cpdeform_stage_finished", "cpdeform_stages_revised", "cpdeform_run_finished"]
    headings = " ".join(line for line in text.splitlines() if line.startswith("## "))
    assert [hook for hook in hooks if hook not in headings] == []
    assert hookimpl.project_name == "cpdeform"


def test_the_plugin_registers_a_part_of_every_kind(registry: Registry) -> None:
    assert not [failure for failure in registry.failures if failure.entry_point == "mine"]
    mine = {item.kind for item in registry.registrations() if item.distribution == "my-package 0.1"}
    assert mine == set(KINDS)


def test_the_simulator_keeps_the_contract_and_its_gradient_is_right(registry: Registry) -> None:
    sketch = registry.load("simulator", "sketch")
    scene = load_task("nudge", registry=registry).scene
    simulator = sketch(scene, dtype=torch.float64)
    state = simulator.initial_state()
    generator = torch.Generator().manual_seed(0)
    actions = torch.rand(1, 3, 3, generator=generator, dtype=torch.float64) - 0.5
    weights = torch.randn(1, 4, scene.particle_count, 3, generator=generator, dtype=torch.float64)
    direction = torch.randn(actions.shape, generator=generator, dtype=torch.float64)

    def value(step: float) -> float:
        return float((weights * simulator.rollout(state, actions + step * direction).positions).sum())

    slope = (value(1e-5) - value(-1e-5)) / 2e-5
    found = simulator.vjp(simulator.rollout(state, actions), weights)
    assert float((found.actions * direction).sum()) == pytest.approx(slope, rel=1e-7)
    check_simulator(sketch, only=CONTRACT).raise_if_failed()


def test_the_solver_and_the_placer_pass_their_checks(registry: Registry) -> None:
    # the two checks that take seconds, of the order of the points and of a pen's stroke, pass as well
    quick = ["translation", "gauge", "differences", "slopes", "identical", "bad arguments"]
    check_ot_solver(registry.create("ot_solver", "dense"), only=quick).raise_if_failed()
    check_placer(registry.create("placer", "above")).raise_if_failed()


def test_a_run_with_these_parts_lowers_the_loss_and_tells_the_observers(
    registry: Registry, site: Path, caplog: pytest.LogCaptureFixture
) -> None:
    small = {
        "workers": 2,
        "executor": "threads",
        "strategy_options": {"iterations": 5},
        "priorities": {"blur": 0.02},
        "objective": {"points": 40, "blur": 0.02},
    }
    with caplog.at_level(logging.INFO, logger="my_package"):
        result = deform(
            "nudge",
            simulator="sketch",
            ot_solver="dense",
            placer="above",
            strategy="patient",
            stages=1,
            settings=small,
            registry=registry,
        )
    assert result.loss_final < 0.8 * result.loss_initial
    assert result.configuration.optimizer.patience == 30
    told = [record.message for record in caplog.records if record.name == "my_package"]
    assert told[0].startswith("stage 0: loss")
    assert told[-1] == f"nudge ended: {result.status.value}"


def test_job_engine_and_command(registry: Registry, site: Path) -> None:
    runner = CliRunner()
    done = runner.invoke(app, ["sweep", "work", "extents", "--engine", "here"], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    assert (site / "extents" / "goals" / "star" / "extent.json").read_text().startswith("[0.")
    assert runner.invoke(app, ["particles", "star"], catch_exceptions=False).stdout.strip() == "10000"
