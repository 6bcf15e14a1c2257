"""The paper's placer on a board with one pen stroke, and its score against a loop."""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest
import torch
from torch import Tensor

from cpdeform.core.errors import CapabilityError, InputError
from cpdeform.core.placer import Proposal, Stage
from cpdeform.core.scene import BodyBox, Scene, ToolCapsule
from cpdeform.core.signed_distance import signed_distance
from cpdeform.core.state import initial_state
from cpdeform.placement.contact_search import score_loss
from cpdeform.placement.transport import PlacerTransport
from cpdeform.testing.placer import transport_of

STROKE = torch.tensor([[0.42, 0.1, 0.45], [0.55, 0.1, 0.58]])


def along_stroke(points: Tensor) -> Tensor:
    """Distance to the stroke."""
    start, end = STROKE.to(points)
    part = ((points - start) @ (end - start) / ((end - start) @ (end - start))).clamp(0.0, 1.0)
    return (points - start - part.unsqueeze(-1) * (end - start)).norm(dim=-1)


def board(count: int = 3000, dtype: torch.dtype = torch.float32, **tool: Any) -> Stage:
    pen = {"position": (0.5, 0.13, 0.5), "rotation_wxyz": (0.0, 0.0, 0.0, 1.0), "action_scale": (0.01, 0.01, 0.01)}
    pen |= {"radius": 0.03, "height": 0.06, "lower_bound": (0.0, 0.05, 0.0)}
    scene = Scene(
        bodies=(BodyBox(position=(0.5, 0.05, 0.5), widths=(0.3, 0.1, 0.3), particle_count=count),),
        tools=(ToolCapsule(**pen | tool),),
    )
    state = initial_state(scene, dtype=dtype)
    priorities = 0.03 * torch.exp(-((along_stroke(state.position[0]) / 0.02) ** 2))
    return Stage(0, scene, state, state.position[0], transport_of(priorities), torch.Generator().manual_seed(0))


def distances(stage: Stage, placement: Proposal) -> Tensor:
    return signed_distance(stage.scene.tools[0], placement.pose[0], stage.state.position[0])


@pytest.mark.parametrize("count", [3000, 10000])
@pytest.mark.parametrize("distance_scale", [1.0, 0.03])
def test_pen_lands_on_the_stroke_in_contact(count: int, distance_scale: float) -> None:
    stage = board(count)
    (placement,) = PlacerTransport(distance_scale=distance_scale).ask(stage)
    x, y, z = placement.pose[0, :3].tolist()
    assert float(along_stroke(torch.tensor([[x, 0.1, z]]))) < 0.015
    assert 0.15 < y < 0.165
    assert -1e-6 <= float(distances(stage, placement).min()) <= 5e-4
    assert placement.contact_particle == int(stage.priorities.argmax())
    assert placement.label == "direct"
    assert torch.equal(placement.pose[0, 3:], stage.state.tool_pose[0, 0, 3:])


def test_score_is_the_papers_formula() -> None:
    stage = board(dtype=torch.float64)
    (placement,) = PlacerTransport(distance_scale=1.0).ask(stage)
    expected = 0.0
    for priority, distance in zip(stage.priorities.tolist(), distances(stage, placement).tolist(), strict=True):
        expected += priority / (distance**2 + 1.0) / 3000
    assert placement.score == pytest.approx(expected, rel=1e-9)


def test_no_touching_position_nearby_scores_higher() -> None:
    stage = board(dtype=torch.float64)
    (placement,) = PlacerTransport(distance_scale=1.0).ask(stage)
    generator, touching = torch.Generator().manual_seed(0), 0
    for _ in range(300):
        pose = placement.pose.clone()
        pose[0, :3] += 0.03 * (torch.rand(3, dtype=torch.float64, generator=generator) - 0.5)
        gap = signed_distance(stage.scene.tools[0], pose[0], stage.state.position[0])
        if 0.0 <= float(gap.min()) <= 5e-4:
            touching += 1
            assert float((stage.priorities / (gap**2 + 1.0)).mean()) <= placement.score + 1e-8
    assert touching >= 5


def test_score_loss_is_the_difference_to_touching_everything() -> None:
    distance, weights = torch.rand(4, 50, dtype=torch.float64), torch.randn(50, dtype=torch.float64)
    for scale in (1.0, 0.1):
        score = (weights / ((distance / scale) ** 2 + 1.0)).sum(dim=-1)
        assert torch.allclose(score_loss(distance, weights, scale), weights.sum() - score, atol=1e-12)


def test_negative_priorities_do_not_push_the_tool_off_the_body() -> None:
    stage = board()
    stage = dataclasses.replace(stage, transport=transport_of(stage.priorities - stage.priorities.mean()))
    (placement,) = PlacerTransport().ask(stage)
    assert -1e-6 <= float(distances(stage, placement).min()) <= 6e-4
    (free,) = PlacerTransport(distance_scale=1.0, max_gap=None).ask(stage)
    assert float(distances(stage, free).min()) > 0.01


def test_clearance_is_kept() -> None:
    stage = board()
    (placement,) = PlacerTransport(clearance=0.004).ask(stage)
    assert 0.004 - 1e-6 <= float(distances(stage, placement).min()) <= 0.0046


def test_bounds_are_kept_and_may_leave_no_position() -> None:
    stage = board(lower_bound=(0.5, 0.05, 0.0))
    (placement,) = PlacerTransport().ask(stage)
    assert float(placement.pose[0, 0]) >= 0.5
    # an interior contact point is out of reach of a tool that has to stay low: it goes to another one, beside the board
    (beside,) = PlacerTransport().ask(board(upper_bound=(1.0, 0.06, 1.0)))
    assert float(beside.pose[0, 1]) <= 0.06
    assert PlacerTransport().ask(board(upper_bound=(0.2, 1.0, 1.0))) == []


def test_is_deterministic_and_leaves_the_state_alone() -> None:
    stage = board()
    before = stage.state.clone()
    first, second = PlacerTransport().ask(stage)[0], PlacerTransport().ask(stage)[0]
    assert torch.equal(first.pose, second.pose)
    assert torch.equal(stage.state.tool_pose, before.tool_pose)
    assert not first.pose.requires_grad


def test_unusable_inputs_are_named() -> None:
    stage = board(100)
    stage = dataclasses.replace(stage, transport=transport_of(torch.full((100,), torch.nan)))
    with pytest.raises(InputError, match="100 not finite"):
        PlacerTransport().ask(stage)
    with pytest.raises(InputError, match="distance_scale: got 0"):
        PlacerTransport(distance_scale=0.0)
    with pytest.raises(CapabilityError, match="no movable tool"):
        PlacerTransport().ask(board(100, action_scale=()))


def test_bodies_that_touch_are_ranked_as_one() -> None:
    """A table's leg that has to move comes first, though the mean over the leg's box is below that of the top."""
    leg = BodyBox(position=(0.45, 0.1, 0.5), widths=(0.04, 0.1, 0.04), particle_count=1000)
    top = BodyBox(position=(0.55, 0.17, 0.5), widths=(0.3, 0.04, 0.2), particle_count=1000)
    scene = Scene(bodies=(leg, top), tools=board().scene.tools)
    state = initial_state(scene)
    x, y, _ = state.position[0].unbind(-1)
    tip = (x < 0.45) & (y < 0.08)
    priorities = torch.where(y > 0.15, 0.005, torch.where(tip, 0.02, -0.01))
    assert priorities[:1000].mean() < priorities[1000:].mean()
    stage = Stage(0, scene, state, state.position[0], transport_of(priorities), torch.Generator().manual_seed(0))
    placements = PlacerTransport(distance_scale=0.01, max_gap=0.005).ask(stage)
    assert [bool(tip[placement.contact_particle]) for placement in placements] == [True]
