"""Transport and misplaced mass together: values at the start and at the goal, gradient, crumbs."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from torch import Tensor

from cpdeform.core.errors import InputError
from cpdeform.core.scene import Scene
from cpdeform.core.simulator import Trajectory
from cpdeform.core.state import initial_state
from cpdeform.planning.objectives.shape import ObjectiveShape
from cpdeform.planning.objectives.transport import ObjectiveTransport

SCENE = Scene.model_validate(
    {
        "bodies": [{"kind": "box", "position": (0.4, 0.4, 0.4), "widths": (0.2, 0.1, 0.2), "particle_count": 300}],
        "tools": [{"kind": "Sphere", "radius": 0.03, "position": (0.4, 0.7, 0.4), "action_scale": (0.02,) * 3}],
    }
)
SHIFT = torch.tensor([0.08, 0.0, 0.0], dtype=torch.float64)


def solver():
    return pytest.importorskip("cpdeform.ot.geomloss").OTSolverGeomLoss(blur=0.01)


def start() -> Tensor:
    return initial_state(SCENE, dtype=torch.float64).position[0]


def path(*clouds: Tensor) -> Trajectory:
    state = initial_state(SCENE, batch_size=len(clouds), dtype=torch.float64)
    positions = torch.stack([torch.stack([start(), cloud]) for cloud in clouds])
    poses = state.tool_pose.unsqueeze(1).repeat(1, 2, 1, 1)
    return Trajectory(positions, poses, torch.zeros(len(clouds), 1, 3, dtype=torch.float64), state, state)


def objective(weight: float = 1.0) -> ObjectiveShape:
    goal = start() + SHIFT
    return ObjectiveShape(ObjectiveTransport(solver(), goal), SCENE, goal, start(), density_weight=weight)


def test_one_of_each_at_the_start_and_nothing_at_the_goal() -> None:
    for weight in (0.0, 1.0, 2.5):
        result = objective(weight).evaluate(path(start(), start() + SHIFT, start() + 0.5 * SHIFT))
        assert result.loss.tolist()[:2] == pytest.approx([1.0 + weight, 0.0], abs=2e-3)
        assert 0.0 < float(result.loss[2]) < 1.0 + weight


def test_gradient_equals_finite_differences() -> None:
    cloud, whole = start() + 0.4 * SHIFT, objective()
    result = whole.evaluate(path(cloud))
    direction = torch.randn(cloud.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    step = 1e-5
    ends = [float(whole.evaluate(path(cloud + sign * step * direction)).loss[0]) for sign in (1.0, -1.0)]
    found = float((result.grad_positions[0, -1] * direction).sum())
    # The transport term is solved to a tolerance, so that its value moves in the fourth digit.
    assert found == pytest.approx((ends[0] - ends[1]) / (2.0 * step), rel=0.05, abs=1e-4)
    assert not result.grad_positions[0, 0].any()


def test_crumbs_cost_more_than_transport_says() -> None:
    """A tenth of the goal's particles scattered about their places: hardly any way to go, but holes and crumbs."""
    crumbly = start() + SHIFT
    generator = torch.Generator().manual_seed(1)
    chosen = torch.randperm(300, generator=generator)[:30]
    crumbly[chosen] += 0.06 * torch.randn(30, 3, dtype=torch.float64, generator=generator)
    plain, whole = objective(0.0), objective(1.0)
    transport = float(plain.evaluate(path(crumbly)).loss[0])
    assert float(whole.evaluate(path(crumbly)).loss[0]) > 1.5 * transport


def test_warm_starts_are_those_of_the_transport() -> None:
    whole = ObjectiveShape(
        ObjectiveTransport(dataclasses.replace(solver()) if dataclasses.is_dataclass(solver()) else solver(), start() + SHIFT),
        SCENE,
        start() + SHIFT,
        start(),
    )
    first = whole.evaluate(path(start() + 0.5 * SHIFT))
    again = whole.evaluate(path(start() + 0.5 * SHIFT), first.warm)
    assert again.loss.tolist() == pytest.approx(first.loss.tolist(), rel=1e-3)


def test_losses_alone_are_the_same() -> None:
    whole, worlds = objective(), path(start(), start() + 0.3 * SHIFT)
    assert torch.allclose(whole.losses(worlds), whole.evaluate(worlds).loss)


def test_tools_below_the_floor_cost_what_lifting_them_saves() -> None:
    """The lowest particle lies on the floor; the sphere of radius 0.03 is sunk by 0.01 at the end of one world."""
    goal = start() + SHIFT
    free, whole = (
        ObjectiveShape(ObjectiveTransport(solver(), goal), SCENE, goal, start(), collision_weight=weight) for weight in (0.0, 0.2)
    )
    low, worlds = float(start()[:, 1].min()), path(start(), start())
    worlds.tool_poses[0, 1, 0, 1] = low + 0.03 - 0.01
    difference = whole.losses(worlds) - free.losses(worlds)
    assert difference.tolist() == pytest.approx([0.2 * 0.5 * (0.01 * SCENE.grid_size) ** 2, 0.0], rel=1e-6)
    result = whole.evaluate(worlds)
    assert torch.allclose(result.loss, whole.losses(worlds))
    assert result.grad_tools is not None
    assert float(result.grad_tools[0, 1, 0, 1]) == pytest.approx(-0.2 * 0.01 * SCENE.grid_size**2, rel=1e-6)
    assert not result.grad_tools[1].any()
    moved = whole.rebased(goal=goal, start=start())
    assert torch.allclose(moved.losses(worlds), result.loss)


def test_a_start_at_the_goal_is_refused() -> None:
    with pytest.raises(InputError, match="start: got the goal itself"):
        ObjectiveShape(ObjectiveTransport(solver(), start()), SCENE, start(), start())
