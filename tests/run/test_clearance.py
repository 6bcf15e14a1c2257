"""Least clearances of a recorded plan against distances that are known in closed form."""

from __future__ import annotations

import types

import pytest
import torch

from cpdeform.core.scene import Scene
from cpdeform.run.clearance import Clearances, measure_clearances, way

BALL = {"kind": "Sphere", "radius": 0.04, "action_scale": [0.01, 0.01, 0.01]}
SCENE = Scene.model_validate(
    {
        "bodies": [{"kind": "box", "position": [0.5, 0.1, 0.5], "widths": [0.1, 0.1, 0.1], "particle_count": 8}],
        "tools": [
            {**BALL, "position": [0.3, 0.1, 0.5]},
            {**BALL, "position": [0.7, 0.1, 0.5]},
            {"kind": "Box", "half_extents": [0.05, 0.02, 0.05], "position": [0.5, 0.6, 0.5]},
        ],
    }
)
CORNERS = torch.cartesian_prod(*(torch.tensor(ends) for ends in ([0.45, 0.55], [0.05, 0.15], [0.45, 0.55])))


def pose(x, y, z):
    return torch.tensor([x, y, z, 1.0, 0.0, 0.0, 0.0, 0.0])


def stage(*steps):
    """An executed stage with the poses of both balls at each step; the clay keeps still."""
    poses = torch.stack([torch.stack([pose(*first), pose(*second), pose(0.5, 0.6, 0.5)]) for first, second in steps])
    state = types.SimpleNamespace(position=CORNERS[None])
    return types.SimpleNamespace(tool_poses=poses, positions=CORNERS.repeat(len(steps), 1, 1), state_before=state)


def record(*stages):
    return types.SimpleNamespace(task=types.SimpleNamespace(scene=SCENE), stages=stages)


def test_distances_of_balls_from_corners_each_other_and_the_floor():
    far = (0.75, 0.3, 0.5)
    first = stage(((0.35, 0.05, 0.45), far), ((0.35, 0.08, 0.45), far))
    found = measure_clearances(record(first, stage(((0.37, 0.2, 0.45), far), ((0.60, 0.2, 0.5), far))))
    # The first ball is 0.1 from the nearest corner at the first start, and nearer at the second one.
    second = ((0.45 - 0.37) ** 2 + 0.05**2) ** 0.5
    assert found.clearance_start == pytest.approx(min(0.1, second) - 0.04, abs=1e-6)
    assert found.clearance_tools == pytest.approx((0.15**2 + 0.1**2) ** 0.5 - 0.08, abs=2e-3)
    # Its centre starts at the height of the lowest particles, so that it reaches a radius below.
    assert found.clearance_floor == pytest.approx(-0.04, abs=1e-3)


def test_the_way_goes_over_the_clay_and_its_ends_are_counted():
    far = (0.75, 0.3, 0.5)
    ends = (0.35, 0.1, 0.5), (0.65, 0.1, 0.5)
    found = measure_clearances(record(stage((ends[0], far), (ends[0], far)), stage((ends[1], far), (ends[1], far))))
    nearest = ((0.45 - 0.35) ** 2 + 2 * 0.05**2) ** 0.5
    assert found.clearance_way is not None
    assert 0.0 < found.clearance_way <= nearest - 0.04 + 1e-6
    through = way(SCENE.tools[0], pose(*ends[0]), pose(*ends[1]), CORNERS)
    assert torch.allclose(through[0], pose(*ends[0]))
    assert torch.allclose(through[-1], pose(*ends[1]))
    over = through[(through[:, 0] > 0.36) & (through[:, 0] < 0.64)]
    assert len(over) > 5
    assert float(over[:, 1].min()) >= 0.15 + 0.04
    assert bool((through[:, 3:7].norm(dim=-1) == 1.0).all())


def test_leaving_a_contact_does_not_count_but_going_deeper_does():
    far, wall = (0.75, 0.3, 0.5), torch.cartesian_prod(torch.tensor([0.45]), torch.linspace(0.05, 0.15, 11), torch.tensor([0.5]))

    def found(particles):
        first, second = (stage((start, far), (start, far)) for start in ((0.415, 0.1, 0.5), (0.35, 0.1, 0.5)))
        first.positions = particles.repeat(2, 1, 1)
        return measure_clearances(record(first, second)).clearance_way

    # 0.005 deep where it ends; it leaves at once, by 0.016 a pose.
    assert found(wall) == pytest.approx(0.011, abs=1e-3)
    # In a narrow pit it scrapes along a ledge on all sides.
    ring = torch.linspace(0.0, 6.28, 60)[:, None]
    ledge = torch.cat([0.415 + 0.03 * torch.cos(ring), torch.full_like(ring, 0.12), 0.5 + 0.03 * torch.sin(ring)], dim=1)
    assert found(torch.cat([wall, ledge])) < -0.008


def test_a_tool_under_an_overhang_goes_aside_before_it_rises():
    """A roof over the tool, open towards +x alone: straight up leads through it."""
    roof = torch.cartesian_prod(torch.linspace(0.3, 0.5, 21), torch.tensor([0.2]), torch.linspace(0.4, 0.6, 21))
    wall = torch.cartesian_prod(torch.tensor([0.3]), torch.linspace(0.05, 0.2, 16), torch.linspace(0.4, 0.6, 21))
    clay, ball = torch.cat([roof, wall]), SCENE.tools[0]
    through = way(ball, pose(0.5, 0.1, 0.5), pose(0.8, 0.1, 0.5), clay)
    least = min(float((clay - step[:3]).norm(dim=-1).min()) for step in through) - 0.04
    # It rises 0.08 beside the edge of the roof.
    assert least == pytest.approx(0.04, abs=1e-3)
    straight = float((clay - torch.tensor([0.5, 0.2, 0.5])).norm(dim=-1).min()) - 0.04
    assert straight < -0.03
    assert torch.allclose(through[0], pose(0.5, 0.1, 0.5))
    assert torch.allclose(through[-1], pose(0.8, 0.1, 0.5))
    back = way(ball, pose(0.8, 0.1, 0.5), pose(0.5, 0.1, 0.5), clay)
    assert torch.allclose(back.flip(0)[:, :3], through[:, :3], atol=1e-6)


def test_without_an_executed_stage_there_is_nothing_to_keep_from():
    idle = types.SimpleNamespace(tool_poses=None, positions=None)
    assert measure_clearances(record(idle)) == Clearances(
        clearance_start=None, clearance_tools=None, clearance_floor=None, clearance_way=None
    )
    assert measure_clearances(record(stage(((0.3, 0.1, 0.5), (0.7, 0.1, 0.5))))).clearance_way is None
