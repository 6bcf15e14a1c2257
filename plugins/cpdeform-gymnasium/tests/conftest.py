"""Settings of the plugin's tests, which run whether the plugin is installed or not."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from cpdeform import Task
from cpdeform.core.plugins import load_registry

sys.path.insert(0, str(Path(__file__).parents[1]))


def make_task(folder: Path) -> Task:
    """A block and a ball above it; the goal is what a press from above makes. Small, so that plain PyTorch simulates it."""
    body = {"kind": "box", "position": (0.5, 0.15, 0.5), "widths": (0.12, 0.1, 0.12), "particle_count": 100}
    ball = {"kind": "Sphere", "radius": 0.04, "position": (0.5, 0.245, 0.5), "action_scale": (0.01,) * 3}
    scene = {"bodies": [body], "tools": [ball], "grid_size": 32, "substeps": 5, "ground_height": 0.05}
    task = Task.model_validate({"name": "press", "scene": scene, "goal": folder / "goal.npz", "step_count": 4})
    simulator = load_registry().create("simulator", "example", scene=task.scene)
    press = torch.tensor([0.0, -1.0, 0.0]).repeat(1, 4, 1)
    np.savez(folder / "goal.npz", position=simulator.rollout(simulator.initial_state(), press).positions[0, -1].numpy())
    return task


@pytest.fixture(scope="session")
def task(tmp_path_factory: pytest.TempPathFactory) -> Task:
    """A small task."""
    return make_task(tmp_path_factory.mktemp("task"))
