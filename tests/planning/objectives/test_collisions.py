"""What plans cost whose tools reach below the floor or into each other."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from cpdeform.core.scene import Scene
from cpdeform.planning.objectives.collisions import ToolCollisions

FLOOR, CELL = 0.05, 1.0 / 64.0
UPRIGHT = (1.0, 0.0, 0.0, 0.0)


def cost(*depths: float) -> float:
    """Of depths, length units."""
    return sum(0.5 * (depth / CELL) ** 2 if depth < CELL else depth / CELL - 0.5 for depth in depths)


def scene(*tools: dict) -> Scene:
    body = {"kind": "box", "position": (0.5, 0.1, 0.5), "widths": (0.1, 0.1, 0.1), "particle_count": 50}
    moves = {"action_scale": (0.01,) * 6}
    return Scene.model_validate({"bodies": [body], "tools": [{**moves, **tool} for tool in tools]})


def sphere(x: float, **changes) -> dict:
    return {"kind": "Sphere", "radius": 0.03, "position": (x, 0.3, 0.5), "action_scale": (0.01,) * 3, **changes}


def plate(**changes) -> dict:
    return {"kind": "Box", "half_extents": (0.04, 0.02, 0.01), "position": (0.5, 0.3, 0.5), **changes}


def poses(*steps: list[tuple[float, ...]]) -> Tensor:
    """Poses (1, T+1, M, 8) of positions and quaternions in T steps, from where they would be without the first motion."""
    whole = torch.tensor([[[*pose, *([] if len(pose) > 3 else UPRIGHT), 0.0] for pose in step] for step in steps]).double()
    whole[..., :3] = torch.tensor([[pose[:3] for pose in step] for step in steps], dtype=torch.float64)
    whole[..., 3:7] = torch.nn.functional.normalize(whole[..., 3:7], dim=-1)
    before = whole[:1].clone()
    before[..., 0] -= 0.001
    return torch.cat([before, whole]).unsqueeze(0)


def test_a_plan_that_is_free_of_collisions_costs_nothing() -> None:
    collisions = ToolCollisions(scene(sphere(0.4), sphere(0.6)), floor=FLOOR)
    found, gradient = collisions.cost_and_gradient(poses([(0.4, 0.081, 0.5), (0.461, 0.081, 0.5)]))
    assert float(found) == 0.0
    assert not gradient.any()


@pytest.mark.parametrize("angle", [0.0, 0.4, math.pi / 2])
def test_depth_below_the_floor_is_that_of_the_lowest_point_in_each_step(angle) -> None:
    """A plate rolled about z: its lowest corner is sin(a) 0.04 + cos(a) 0.02 below its centre."""
    collisions = ToolCollisions(scene(plate()), floor=FLOOR)
    turn = (math.cos(angle / 2), 0.0, 0.0, math.sin(angle / 2))
    low = math.sin(angle) * 0.04 + math.cos(angle) * 0.02
    steps = [[(0.5, FLOOR + low - depth, 0.5, *turn)] for depth in (-0.01, 0.004, 0.03)]
    assert float(collisions.cost(poses(*steps))) == pytest.approx(cost(0.004, 0.03), rel=1e-6)


def test_depth_in_another_tool_counts_for_each_tool_that_moves() -> None:
    both = poses([(0.4, 0.3, 0.5), (0.45, 0.3, 0.5)])
    assert float(ToolCollisions(scene(sphere(0.4), sphere(0.6)), floor=FLOOR).cost(both)) == pytest.approx(
        cost(0.01, 0.01), rel=0.04
    )
    still = sphere(0.6, action_scale=())
    assert float(ToolCollisions(scene(sphere(0.4), still), floor=FLOOR).cost(both)) == pytest.approx(cost(0.01), rel=0.04)


def test_what_the_scene_puts_below_the_floor_does_not_count_there() -> None:
    low = scene(sphere(0.4, position=(0.4, 0.06, 0.5)))
    collisions = ToolCollisions(low, floor=FLOOR)
    assert float(collisions.cost(poses([(0.4, 0.06, 0.5)]))) == pytest.approx(0.0, abs=1e-9)
    assert float(collisions.cost(poses([(0.4, 0.05, 0.5)]))) == pytest.approx(cost(0.01), rel=1e-6)


def test_a_tool_that_stands_still_costs_nothing() -> None:
    """Wherever the stage before has left it. The other one pays for the step in which it moves into it, below the floor."""
    collisions = ToolCollisions(scene(sphere(0.4), sphere(0.6)), floor=FLOOR)
    still = poses([(0.4, 0.07, 0.5), (0.45, 0.07, 0.5)])[:, 1:].repeat(1, 4, 1, 1)
    assert float(collisions.cost(still)) == 0.0
    still[:, :2, 1, 2] += 0.2
    assert float(collisions.cost(still)) == pytest.approx(cost(0.01, 0.01), rel=0.04)


def test_gradient_equals_finite_differences() -> None:
    collisions = ToolCollisions(scene(plate(), plate()), floor=FLOOR)
    turn, other = torch.tensor([0.9, 0.1, 0.3, 0.2]), torch.tensor([0.8, -0.3, 0.2, 0.1])
    first, second = (0.5, 0.05, 0.5, *(turn / turn.norm()).tolist()), (0.53, 0.056, 0.49, *(other / other.norm()).tolist())
    at = poses([first, second])
    found, gradient = collisions.cost_and_gradient(at)
    assert float(found) > 1.0
    direction = torch.randn(at.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    direction[..., 7] = 0.0
    # Of where the tools begin, only the motion counts.
    assert not gradient[:, 0].any()
    step = 1e-7
    difference = (float(collisions.cost(at + step * direction)) - float(collisions.cost(at - step * direction))) / (2.0 * step)
    assert float((gradient * direction).sum()) == pytest.approx(difference, rel=1e-5)
