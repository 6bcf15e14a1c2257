"""PlasticineLab's objective against hand-written sums, its own gradient, and PlasticineLab's recorded values."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from golden import NAMES, golden_path
from scipy.spatial import cKDTree

from cpdeform.core.errors import InputError
from cpdeform.core.scene import BodyBox, Scene, ToolSphere
from cpdeform.core.simulator import Trajectory
from cpdeform.core.state import initial_state
from cpdeform.planning.objectives import plasticinelab
from cpdeform.planning.objectives.metrics import incremental_iou, soft_iou
from cpdeform.planning.objectives.plasticinelab import ObjectivePlasticineLab, goal_distance, mass_grid
from cpdeform.testing import read_golden
from cpdeform.testing.golden_file import recorded_poses

WITH_GOAL = [name for name in NAMES if not name.startswith("multistage_")]
"""Recordings whose target grid was published."""


def small_scene() -> Scene:
    body = BodyBox(position=(0.5, 0.4, 0.5), widths=(0.3, 0.3, 0.3), particle_count=60)
    tool = ToolSphere(position=(0.5, 0.7, 0.5), radius=0.05, action_scale=(0.01, 0.01, 0.01))
    return Scene(bodies=(body,), tools=(tool,), grid_size=16)


def trajectory(steps: int = 2) -> Trajectory:
    state = initial_state(small_scene(), batch_size=2, dtype=torch.float64)
    noise = torch.randn(2, steps + 1, 60, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    positions = state.position.unsqueeze(1) + 0.02 * noise
    poses = state.tool_pose.unsqueeze(1).repeat(1, steps + 1, 1, 1)
    actions = torch.zeros(2, steps, 3, dtype=torch.float64)
    return Trajectory(positions, poses, actions, initial_state=state, final_state=state)


def make_goal() -> torch.Tensor:
    scene = small_scene()
    return mass_grid(initial_state(scene, dtype=torch.float64).position[0] + torch.tensor([0.1, 0.0, 0.0]), scene)


def test_goal_distance_is_that_to_the_nearest_occupied_node() -> None:
    grid = make_goal()
    occupied = np.argwhere(grid.numpy() > 1e-4) / 16
    nodes = np.stack(np.meshgrid(*[np.arange(16) / 16] * 3, indexing="ij"), axis=-1)
    expected = cKDTree(occupied).query(nodes)[0]
    assert np.allclose(goal_distance(grid).numpy(), expected, atol=1e-6)


def test_loss_is_the_weighted_sum_over_the_steps_but_the_start() -> None:
    scene, goal, path = small_scene(), make_goal(), trajectory()
    result = ObjectivePlasticineLab(scene, goal).evaluate(path)
    for world in range(2):
        expected = 0.0
        for step in (1, 2):
            mass = mass_grid(path.positions[world, step], scene)
            gap = (path.positions[world, step] - path.tool_poses[world, step, 0, :3]).norm(dim=-1).min() - 0.05
            expected += 10.0 * float((mass - goal).abs().sum()) + 10.0 * float((mass * goal_distance(goal)).sum())
            expected += float(gap.clamp(min=0.0)) ** 2
        assert float(result.loss[world]) == pytest.approx(expected, rel=1e-10)
    assert float(result.grad_positions[:, 0].abs().max()) == 0.0
    assert result.grad_tools is not None


def test_gradient_matches_finite_differences_in_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    path = trajectory(steps=1)
    objective = ObjectivePlasticineLab(small_scene(), make_goal(), contact="soft")
    whole = objective.evaluate(path)
    monkeypatch.setattr(plasticinelab, "CHUNK_VALUES", 1)
    result = objective.evaluate(path)
    assert torch.allclose(result.grad_positions, whole.grad_positions, atol=1e-12)
    direction = torch.randn(path.positions.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    step = 1e-7
    values = [objective.loss(path.positions + sign * step * direction, path.tool_poses).sum() for sign in (1, -1)]
    assert float((values[0] - values[1]) / (2 * step)) == pytest.approx(float((result.grad_positions * direction).sum()), rel=1e-5)


@pytest.mark.parametrize("name", ["density_weight", "sdf_weight", "contact_weight"])
def test_negative_weights_are_named(name: str) -> None:
    with pytest.raises(InputError, match=f"{name}: got -1"):
        ObjectivePlasticineLab(small_scene(), make_goal(), **{name: -1.0})  # type: ignore[arg-type]


def test_unusable_goals_are_named() -> None:
    with pytest.raises(InputError, match="goal_grid: got shape"):
        ObjectivePlasticineLab(small_scene(), torch.ones(8, 8, 8))
    with pytest.raises(InputError, match="largest node mass of 0"):
        ObjectivePlasticineLab(small_scene(), torch.zeros(16, 16, 16))
    with pytest.raises(InputError, match="negative or non-finite"):
        ObjectivePlasticineLab(small_scene(), -make_goal())


@pytest.mark.parametrize("name", WITH_GOAL)
def test_terms_and_metrics_equal_plasticinelabs(name: str) -> None:
    golden = read_golden(golden_path(name))
    recorded, scene, goal = golden.arrays, golden.scene, golden.goal_grid
    assert goal is not None
    positions = torch.as_tensor(recorded["x"])
    poses = recorded_poses(scene, recorded["prim"])[-1]
    terms = ObjectivePlasticineLab(scene, goal).terms(positions, poses)
    # The published grids are float32, hence the tolerance on all that depends on the goal's masses.
    assert float(terms["density"]) == pytest.approx(recorded["density"][-1], rel=1e-7)
    assert float(terms["sdf"]) == pytest.approx(recorded["sdf"][-1], rel=1e-12)
    assert float(terms["contact"]) == pytest.approx(recorded["contact"][-1], rel=1e-8, abs=1e-12)
    mass, start = mass_grid(positions, scene), mass_grid(torch.as_tensor(recorded["x0"]), scene)
    assert float(soft_iou(mass, goal)) == pytest.approx(recorded["iou"][-1], abs=1e-7)
    assert float(soft_iou(start, goal)) == pytest.approx(float(recorded["init_iou"]), abs=1e-7)
    assert float(soft_iou(goal, goal)) == pytest.approx(float(recorded["target_iou"]), abs=1e-7)
    assert float(incremental_iou(mass, start, goal)) == pytest.approx(recorded["incremental_iou"][-1], abs=1e-6)
    total = 10.0 * recorded["density"].sum() + 10.0 * recorded["sdf"].sum() + recorded["contact"].sum()
    assert total == pytest.approx(float(recorded["total_loss"]), rel=1e-12)
