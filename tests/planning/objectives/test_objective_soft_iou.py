"""What is missing of the soft IoU: its range, what counts, its gradient."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from cpdeform.core.errors import InputError
from cpdeform.core.scene import BodyBox, Scene
from cpdeform.core.simulator import Trajectory
from cpdeform.core.state import initial_state
from cpdeform.planning.objectives.mass import mass_grid
from cpdeform.planning.objectives.metrics import incremental_iou
from cpdeform.planning.objectives.soft_iou import ObjectiveSoftIoU

SCENE = Scene(grid_size=16, bodies=(BodyBox(position=(0.4, 0.4, 0.5), widths=(0.2, 0.2, 0.2), particle_count=40),))
START = initial_state(SCENE, batch_size=2, dtype=torch.float64)


def trajectory(*last: Tensor) -> Trajectory:
    """Two worlds of two steps that end with the given clouds (N, 3)."""
    positions = torch.stack([START.position, START.position, torch.stack(last)], dim=1)
    poses = START.tool_pose.unsqueeze(1).repeat(1, 3, 1, 1)
    return Trajectory(positions, poses, torch.zeros(2, 2, 0, dtype=torch.float64), START, START)


def test_the_goal_misses_nothing_and_a_shape_elsewhere_all_of_it() -> None:
    goal = START.position[0] + torch.tensor([0.0, 0.0, 0.1], dtype=torch.float64)
    away = START.position[0] + torch.tensor([0.4, 0.0, 0.0], dtype=torch.float64)
    result = ObjectiveSoftIoU(SCENE, mass_grid(goal, SCENE)).evaluate(trajectory(goal, away))
    assert torch.allclose(result.loss, torch.tensor([0.0, 1.0], dtype=torch.float64), atol=1e-12)
    assert not result.grad_positions[:, :-1].any()


def test_it_is_the_metric_of_a_run_that_started_away_from_the_goal() -> None:
    generator = torch.Generator().manual_seed(0)
    goal, cloud = (START.position[0] + 0.02 * torch.randn(40, 3, generator=generator, dtype=torch.float64) for _ in range(2))
    away = goal + torch.tensor([0.4, 0.0, 0.0], dtype=torch.float64)
    goal_grid = mass_grid(goal, SCENE)
    loss = ObjectiveSoftIoU(SCENE, goal_grid).evaluate(trajectory(cloud, cloud)).loss
    metric = incremental_iou(mass_grid(cloud, SCENE), mass_grid(away, SCENE), goal_grid)
    assert 0.1 < float(metric) < 0.99
    assert float(loss[0]) == pytest.approx(1.0 - float(metric))


def test_the_gradient_is_that_of_finite_differences() -> None:
    generator = torch.Generator().manual_seed(0)
    goal, cloud = (START.position[0] + 0.02 * torch.randn(40, 3, generator=generator, dtype=torch.float64) for _ in range(2))
    objective = ObjectiveSoftIoU(SCENE, mass_grid(goal, SCENE))
    direction = torch.randn(40, 3, generator=generator, dtype=torch.float64)
    slope = (objective.evaluate(trajectory(cloud, cloud)).grad_positions[0, -1] * direction).sum()
    ahead, back = (objective.evaluate(trajectory(cloud + sign * 1e-6 * direction, cloud)).loss[0] for sign in (1.0, -1.0))
    assert float(slope) == pytest.approx(float(ahead - back) / 2e-6, rel=1e-5)


def test_a_goal_that_does_not_fit_is_named() -> None:
    with pytest.raises(InputError, match=r"goal_grid: got shape \(8, 8, 8\), expected shape \(16, 16, 16\)"):
        ObjectiveSoftIoU(SCENE, torch.ones(8, 8, 8))
    with pytest.raises(InputError, match="goal_grid: got no mass"):
        ObjectiveSoftIoU(SCENE, torch.zeros(16, 16, 16))
