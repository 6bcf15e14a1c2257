"""A proposer, a phase and a pruner from outside, each in a file of its own, in a run."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

import cpdeform_example
from cpdeform import Task, deform
from cpdeform_example.pruner import PrunerMargin
from cpdeform_example.simulator import SimulatorExample
from cpdeform_example.strategy import StrategyExample

LINES = 60


@pytest.fixture
def task(tmp_path: Path) -> Task:
    """A block and a ball above it; the goal is what a press from above makes."""
    body = {"kind": "box", "position": (0.5, 0.15, 0.5), "widths": (0.12, 0.1, 0.12), "particle_count": 100}
    ball = {"kind": "Sphere", "radius": 0.04, "position": (0.5, 0.245, 0.5), "action_scale": (0.01,) * 3}
    scene = {"bodies": [body], "tools": [ball], "grid_size": 32, "substeps": 5, "ground_height": 0.05}
    task = Task.model_validate({"name": "press", "scene": scene, "goal": tmp_path / "goal.npz", "step_count": 4})
    simulator = SimulatorExample(task.scene)
    press = torch.tensor([0.0, -1.0, 0.0]).repeat(1, 4, 1)
    np.savez(task.goal, position=simulator.rollout(simulator.initial_state(), press).positions[0, -1].numpy())
    return task


def test_each_addition_is_short() -> None:
    root = Path(cpdeform_example.__file__).parent
    for name in ("proposer", "phase", "pruner", "strategy"):
        assert len((root / f"{name}.py").read_text().splitlines()) < LINES, name


def test_a_run_with_all_of_them(task: Task) -> None:
    settings = {"optimizer": {"iterations": 4, "learning_rate": 0.2}}
    result = deform(task, simulator=SimulatorExample(task.scene, batch_size=4), strategy="example", settings=settings)
    (stage,) = result.stages
    labels = [candidate.proposal.label for candidate in stage.candidates]
    assert labels == ["direct", "above"]
    above = stage.candidates[1].proposal
    assert above.actions is not None
    # It begins to press as it was proposed, and the descent goes on from there.
    assert bool((above.actions[:, 1] == -0.5).all())
    assert stage.loss < 0.5 * stage.loss_before
    # Four variations, and the executions of the plan and of the best of them.
    assert stage.rollouts == 4 + 2
    assert "variation" in stage.seconds


def test_options_of_the_strategy_and_its_pruner() -> None:
    assert StrategyExample(speed=0.25).speed == 0.25
    losses, active = torch.tensor([1.0, 1.05, 1.2], dtype=torch.float64), torch.arange(3)
    assert PrunerMargin().survivors(active, losses, done=1, iterations=9).tolist() == [0, 1, 2]
    assert PrunerMargin().survivors(active, losses, done=2, iterations=9).tolist() == [0, 1]
