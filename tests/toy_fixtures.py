"""Fixtures about the toy parts of `tests/toys`; imported by the conftest of the folders that use them."""

from __future__ import annotations

import importlib.metadata
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import yaml

TOYS = Path(__file__).parent / "toys"
sys.path.insert(0, str(TOYS))


def write_toy_distribution(directory: Path) -> Path:
    """A folder with the metadata of an installed distribution `cpdeform-toy`; on sys.path it makes the toys discoverable."""
    site = directory / "site"
    metadata = site / "cpdeform_toy-0.1.dist-info"
    metadata.mkdir(parents=True)
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: cpdeform-toy\nVersion: 0.1\n")
    (metadata / "entry_points.txt").write_text("[cpdeform]\ntoy = cpdeform_toy.plugin\n")
    return site


@pytest.fixture
def toy_distribution(tmp_path: Path) -> Path:
    return write_toy_distribution(tmp_path)


@pytest.fixture
def toy_entry_points() -> list[importlib.metadata.EntryPoint]:
    modules = {"toy": "cpdeform_toy.plugin", "strategies": "cpdeform.planning.plugin"}
    return [importlib.metadata.EntryPoint(name, module, "cpdeform") for name, module in modules.items()]


def write_toy_task(directory: Path, *, offset: float = 0.1, **fields: object) -> Path:
    """Write a task file with its goal: a ball, to be shifted by `offset` along x."""
    from cpdeform.core.sampling import sample_particles
    from cpdeform.core.scene import Scene

    scene = {
        "bodies": [{"kind": "sphere", "position": [0.4, 0.4, 0.4], "radius": 0.1, "particle_count": 60}],
        "tools": [{"kind": "Sphere", "radius": 0.05, "position": [0.4, 0.7, 0.4], "action_scale": [0.02, 0.02, 0.02]}],
    }
    goal = sample_particles(Scene.model_validate(scene)) + np.array([offset, 0.0, 0.0])
    np.savez(directory / "goal.npz", position=goal)
    task = {"name": "shift", "scene": scene, "goal": "goal.npz", "step_count": 5, "stage_count": 2, **fields}
    path = directory / "shift.yaml"
    path.write_text(yaml.safe_dump(task))
    return path


@pytest.fixture
def toy_task_file(tmp_path: Path) -> Path:
    return write_toy_task(tmp_path)


@pytest.fixture
def make_toy_task(tmp_path: Path) -> Callable[..., Path]:
    return lambda **fields: write_toy_task(tmp_path, **fields)
