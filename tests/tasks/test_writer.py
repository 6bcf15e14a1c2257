"""The task `writer`: its goals are this project's own, reproducible, and out of reach from the pen's start."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from cpdeform import load_task
from cpdeform.backends.warp.simulator import SimulatorWarp
from cpdeform.core.goal import POSITION_SCALE
from cpdeform.core.sampling import sample_particles
from cpdeform.core.signed_distance import signed_distance
from cpdeform.core.state import tool_pose
from cpdeform.core.task import Task
from cpdeform.planning.objectives.metrics import soft_iou
from cpdeform.planning.objectives.plasticinelab import mass_grid
from cpdeform.tasks.single_stage import SINGLE_STAGE

VARIANTS = ("v1", "v2", "v3", "v4", "v5")


@pytest.fixture(params=VARIANTS)
def task(request: pytest.FixtureRequest) -> Task:
    return load_task(f"writer-{request.param}")


def displacement(task: Task) -> np.ndarray:
    return np.linalg.norm(task.load_goal() - sample_particles(task.scene), axis=1)


def test_every_variant_has_a_stroke_and_a_goal() -> None:
    assert [name for name in SINGLE_STAGE if name.startswith("writer-")] == [f"writer-{variant}" for variant in VARIANTS]
    goals = [load_task(f"writer-{variant}").load_goal() for variant in VARIANTS]
    assert len({goal.tobytes() for goal in goals}) == len(VARIANTS)
    assert load_task("writer").name == "writer-v1"


def test_goal_is_the_board_with_one_local_stroke(task: Task) -> None:
    moved = displacement(task)
    assert moved.max() > 0.02
    assert np.quantile(moved, 0.5) < 0.003
    assert 0.01 < (moved > 0.01).mean() < 0.25


def test_pen_starts_outside_the_body_and_beside_the_stroke(task: Task) -> None:
    particles = torch.as_tensor(sample_particles(task.scene))
    pose = tool_pose(task.scene)
    pen = task.scene.tools[0]
    assert float(signed_distance(pen, pose[0], particles).min()) > 0.0
    start = sample_particles(task.scene)
    pressed = start[displacement(task) > 0.02]
    away = np.linalg.norm(pressed[:, [0, 2]] - np.asarray(pen.position)[[0, 2]], axis=1)
    assert away.min() > 0.01
    assert np.median(away) > 0.05


def test_goal_is_nearer_to_itself_than_the_start_is(task: Task) -> None:
    """Otherwise the normalised incremental IoU would have no way to go."""
    start = mass_grid(torch.as_tensor(sample_particles(task.scene)), task.scene)
    goal = mass_grid(torch.as_tensor(task.load_goal()), task.scene)
    assert float(soft_iou(goal, goal) - soft_iou(start, goal)) > 1e-3


def test_goal_files_are_compact(task: Task) -> None:
    assert task.goal.stat().st_size < 80_000


@pytest.mark.slow
def test_warp_draws_the_stroke_within_a_unit() -> None:
    """The files are made by the native simulator where there is one; another may round the last unit differently."""
    task = load_task("writer-v1")
    maker, corresponds = SINGLE_STAGE[task.name]
    drawn = maker(task.scene, lambda: SimulatorWarp(task.scene, dtype=torch.float64))
    difference = np.abs(np.rint(drawn * POSITION_SCALE) - task.load_goal() * POSITION_SCALE)
    assert corresponds
    assert (difference <= 1.0).mean() > 0.999
