"""Touches: free of the clay and above the floor, in the tools' power, drawn where clay has far to go, repeatable, varied nearby."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from cpdeform.core.clearance import CLEARANCE, SMALLEST_STEP, tool_half_extents
from cpdeform.core.errors import InputError
from cpdeform.core.placer import Candidate, Stage
from cpdeform.core.rotation import rotate
from cpdeform.core.scene import Scene
from cpdeform.core.signed_distance import signed_distance
from cpdeform.core.state import initial_state
from cpdeform.placement.touches.parking import parked
from cpdeform.placement.touches.pinch import TouchPinch
from cpdeform.placement.touches.placer import PlacerTouch, place
from cpdeform.placement.touches.push import TouchPress, TouchPush
from cpdeform.placement.touches.stroke import TouchStroke
from cpdeform.placement.touches.touch import Room, facing
from cpdeform.testing.placer import transport_of

BLADE = {
    "kind": "Box",
    "half_extents": (0.01, 0.08, 0.04),
    "rounding": 0.005,
    "action_scale": (0.01, 0.01, 0.01),
}
BALL = {"kind": "Sphere", "radius": 0.03, "action_scale": (0.02, 0.0, 0.02)}
PEN = {"kind": "Capsule", "radius": 0.02, "height": 0.04, "action_scale": (0.02, 0.02, 0.02)}
SHIFT = torch.tensor([0.05, 0.0, 0.0])


def make_stage(*tools: dict, seed: int = 0, steps: int = 10) -> Stage:
    """A block whose right half is to move to the right, and tools above it."""
    body = {"kind": "box", "position": (0.5, 0.35, 0.5), "widths": (0.24, 0.1, 0.2), "particle_count": 1500}
    placed = [{"position": (0.3 + 0.4 * number, 0.7, 0.5), **tool} for number, tool in enumerate(tools)]
    scene = Scene.model_validate({"bodies": [body], "tools": placed, "ground_height": 0.27})
    state = initial_state(scene)
    right = state.position[0, :, :1] > 0.5
    displacements = torch.where(right, SHIFT, torch.zeros(3))
    generator = torch.Generator().manual_seed(seed)
    transport = transport_of(displacements.norm(dim=1), displacements)
    return Stage(0, scene, state, state.position[0] + displacements, transport, generator, loss=1.0, step_count=steps)


def make_room(stage: Stage) -> Room:
    from cpdeform.placement.touches.placer import _begin

    return _begin(stage).room


@pytest.mark.parametrize("tools", [(BLADE, BLADE), (BALL,), (BALL, BLADE)])
def test_tools_begin_free_of_the_clay_and_of_each_other(tools) -> None:
    stage = make_stage(*tools)
    proposals = PlacerTouch(count=24).ask(stage)
    assert len(proposals) == 24
    particles = stage.state.position[0]
    floor = float(particles[:, 1].min())
    for proposal in proposals:
        assert proposal.actions is not None
        assert proposal.actions.shape == (10, 3 * len(tools))
        assert float(proposal.actions.abs().max()) <= 1.0
        assert proposal.actions.any()
        for tool, pose in zip(stage.scene.tools, proposal.pose, strict=True):
            gap = float(signed_distance(tool, pose, particles).min())
            assert gap >= 0.9 * CLEARANCE
            assert float(pose[1]) - float(tool_half_extents(tool, pose[3:7])[1]) >= floor - 1e-5
            assert float(pose[3:7].norm()) == pytest.approx(1.0, abs=1e-5)
        for index, pose in enumerate(proposal.pose):
            for other in range(index):
                distance = float((pose[:3] - proposal.pose[other, :3]).norm())
                assert distance > 0.02
    if len(tools) == 2:
        assert {"push", "pinch"} <= {part for proposal in proposals for part in proposal.label.split("+")}


def test_contacts_lie_where_the_clay_has_far_to_go() -> None:
    stage = make_stage(BLADE, BLADE)
    proposals = PlacerTouch(count=40).ask(stage)
    pushed = [item.contact_particle for item in proposals if item.label in ("push", "pinch", "drag")]
    assert len(pushed) > 10
    assert all(float(stage.state.position[0, particle, 0]) > 0.49 for particle in pushed)


def test_tools_move_towards_the_clay_and_back_off_at_the_end() -> None:
    stage = make_stage(BALL)
    room = make_room(stage)
    push = TouchPush(tool=0, contact=np.array([0.6, 0.35, 0.5]), direction=np.array([1.0, 0.0, 0.0]), way=0.04)
    found = place(push, room, steps=10)
    assert found is not None
    poses, actions = found
    # It stands on the far side of the block and pushes it along; it just does not touch.
    assert float(poses[0, 0]) < 0.36
    gap = float(signed_distance(stage.scene.tools[0], poses[0], room.particles).min())
    assert CLEARANCE <= gap + 1e-6 < CLEARANCE + SMALLEST_STEP
    assert torch.allclose(actions[:8, 0], torch.full((8,), 0.04 / 8 / 0.02))
    assert bool((actions[8:, 0] < 0.0).all())
    assert not actions[:, 1:].any()


def test_a_stroke_comes_down_and_goes_along_and_lifts_at_the_end() -> None:
    room = make_room(make_stage(PEN))
    stroke = TouchStroke(tool=0, contact=np.array([0.55, 0.4, 0.5]), direction=np.array([0.03, 0.5, 0.04]), way=0.06, depth=0.02)
    found = place(stroke, room, steps=10)
    assert found is not None
    poses, actions = found
    top = float(room.particles[:, 1].max())
    assert poses[0, [0, 2]].tolist() == pytest.approx([0.55, 0.5])
    assert float(poses[0, 1]) == pytest.approx(top + 0.5 * PEN["height"] + PEN["radius"], abs=0.01)
    moved = 0.02 * actions
    assert not actions[:2, [0, 2]].any()
    assert float(moved[:2, 1].sum()) == pytest.approx(-0.02)
    # The rest of its way is level, along the level part of the direction.
    assert moved[2:8].sum(dim=0).tolist() == pytest.approx([0.036, 0.0, 0.048], abs=1e-6)
    assert not actions[8:, [0, 2]].any()
    assert bool((actions[8:, 1] > 0.0).all())


def test_strokes_are_drawn_where_clay_is_to_go_down_by_a_single_round_tool_that_can() -> None:
    stage = make_stage(PEN)
    down = torch.where(stage.state.position[0, :, 2:] > 0.5, torch.tensor([0.0, -0.03, 0.0]), torch.zeros(3))
    stage = dataclasses.replace(stage, transport=transport_of(down.norm(dim=1), down))
    proposals = [item for item in PlacerTouch(count=60).ask(stage) if item.label == "stroke"]
    assert len(proposals) > 10
    ends = [item.pose[0, :3] + 0.02 * item.actions[:8].sum(dim=0) for item in proposals if item.actions is not None]
    assert all(float(place[2]) > 0.49 for item, end in zip(proposals, ends, strict=True) for place in (item.pose[0], end))
    for tools in ((BALL,), (BLADE,), (PEN, PEN)):
        assert "stroke" not in {item.label for item in PlacerTouch(count=40).ask(make_stage(*tools))}


def test_a_way_that_is_too_long_keeps_its_direction() -> None:
    room = make_room(make_stage({**BALL, "action_scale": (0.01, 0.01, 0.01)}))
    push = TouchPush(tool=0, contact=np.array([0.5, 0.35, 0.5]), direction=np.array([1.0, 0.0, 0.5]), way=5.0)
    found = place(push, room, steps=10)
    assert found is not None
    assert torch.allclose(found[1][0], torch.tensor([1.0, 0.0, 0.5]), atol=1e-6)


def test_there_is_no_room_below_the_floor_or_out_of_bounds() -> None:
    room = make_room(make_stage({**BLADE, "upper_bound": (1.0, 0.75, 1.0), "lower_bound": (0.0, 0.4, 0.0)}))
    contact = np.array([0.5, 0.31, 0.5])
    up = TouchPush(tool=0, contact=contact, direction=np.array([0.0, 1.0, 0.0]), way=0.02)
    level = TouchPush(tool=0, contact=contact, direction=np.array([1.0, 0.0, 0.0]), way=0.02)
    assert up.moves(room) is None
    assert level.moves(room) is None
    assert TouchPress(tool=0, contact=contact, direction=np.array([0.0, -1.0, 0.0]), way=0.02).moves(room) is not None


def test_a_tool_that_the_scene_keeps_below_the_floor_may_stay_as_low() -> None:
    """Such as the balls of rope++, whose bounds end lower than a ball on the floor."""
    bounds = {"lower_bound": (0.0, 0.31, 0.0), "upper_bound": (1.0, 0.32, 1.0)}
    low = {**BALL, **bounds, "position": (0.2, 0.315, 0.5)}
    stage = make_stage(low, {**low, "position": (0.8, 0.315, 0.5)})
    assert float(stage.state.position[0, :, 1].min()) + BALL["radius"] > bounds["upper_bound"][1]
    proposals = PlacerTouch(count=8).ask(stage)
    assert proposals
    assert all(bool((proposal.pose[:, 1] >= 0.315 - 1e-5).all()) for proposal in proposals)


def test_tools_that_cannot_wait_above_the_clay_wait_beside_it() -> None:
    bounds = {"lower_bound": (0.1, 0.31, 0.1), "upper_bound": (0.9, 0.37, 0.9)}
    low = {**BALL, **bounds, "position": (0.2, 0.315, 0.5)}
    # With two tools they would wait at x = 0.25 and 0.75, with one at 0.5: in the clay.
    stage = make_stage(low)
    (pose,) = parked(stage, [0])
    gap = float(signed_distance(stage.scene.tools[0], pose, stage.state.position[0]).min())
    assert gap > 0.2
    assert bool((pose[:3] >= torch.tensor(bounds["lower_bound"])).all())
    assert bool((pose[:3] <= torch.tensor(bounds["upper_bound"])).all())
    assert parked(make_stage(BALL, BALL), [0, 1])[:, 1].tolist() == pytest.approx([0.9, 0.9])
    crowd = make_stage(*3 * (low,))
    poses = parked(crowd, [0, 1, 2])
    assert float(torch.pdist(poses[:, :3]).min()) > 2.0 * BALL["radius"]


def test_a_pinch_closes_from_both_sides() -> None:
    stage = make_stage(BLADE, BLADE)
    room = make_room(stage)
    pinch = TouchPinch(
        tools=(0, 1),
        contact=np.array([0.6, 0.35, 0.5]),
        direction=np.array([1.0, 0.0, 0.0]),
        side=0.0,
        tilts=(0.0, 0.0),
        closings=(0.03, 0.02),
        pull=0.01,
    )
    moves = pinch.moves(room)
    assert moves is not None
    assert float(moves[0].pose[2]) * 2.0 + float(moves[1].pose[2]) * 2.0 == pytest.approx(2.0, abs=0.02)
    assert float(moves[0].way[2]) * float(moves[1].way[2]) == pytest.approx(-0.03 * 0.02, rel=1e-4)
    assert float(moves[0].way[0]) == pytest.approx(0.01, rel=1e-4)
    for index in (0, 1):
        face = rotate(moves[index].pose[3:7], torch.tensor([1.0, 0.0, 0.0]))
        assert abs(float(face[2])) == pytest.approx(1.0, abs=1e-4)


def test_blades_face_where_they_push_and_stay_upright() -> None:
    scene = make_stage(BLADE).scene
    direction = torch.tensor([0.6, 0.0, 0.8])
    broad = facing(scene.tools[0], direction, edge=False, roll=0.0)
    edge = facing(scene.tools[0], direction, edge=True, roll=0.0)
    assert torch.allclose(rotate(broad, torch.tensor([1.0, 0.0, 0.0])), direction, atol=1e-5)
    assert torch.allclose(rotate(edge, torch.tensor([0.0, 0.0, 1.0])), direction, atol=1e-5)
    for rotation in (broad, edge):
        assert torch.allclose(rotate(rotation, torch.tensor([0.0, 1.0, 0.0])), torch.tensor([0.0, 1.0, 0.0]), atol=1e-5)


def test_the_best_are_varied_and_the_same_seed_repeats() -> None:
    def rounds(seed: int):
        placer, stage = PlacerTouch(count=12, variations=8, widths=(0.5,), parents=2), make_stage(BLADE, BLADE, seed=seed)
        first = placer.ask(stage)
        losses = [float(number) for number in range(len(first))]
        results = [Candidate(item, loss, item.pose) for item, loss in zip(first, losses, strict=True)]
        assert placer.tell(results)
        second = placer.ask(stage)
        assert not placer.tell([Candidate(item, 1.0, item.pose) for item in second])
        return first, second

    first, second = rounds(0)
    assert {item.contact_particle for item in second} <= {item.contact_particle for item in first[:2]}
    assert {item.label for item in second} <= {item.label for item in first[:2]}
    for one, other in zip(rounds(0), (first, second), strict=True):
        assert all(torch.equal(a.pose, b.pose) for a, b in zip(one, other, strict=True))
    assert not torch.equal(rounds(1)[0][0].pose, first[0].pose)


def test_options_out_of_range_are_named() -> None:
    with pytest.raises(InputError, match="count: got 0"):
        PlacerTouch(count=0)
    with pytest.raises(InputError, match="widths"):
        PlacerTouch(widths=(0.0,))
