"""Several tools: grasps along three directions, several bodies, contact points that were tried, exact touching."""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest
import torch
from torch import Tensor

from cpdeform.core.clearance import exit_distances
from cpdeform.core.errors import InputError
from cpdeform.core.placer import Candidate, Proposal, Stage
from cpdeform.core.rotation import rotate
from cpdeform.core.scene import BodyBox, Scene, ToolBase, ToolBox, ToolSphere
from cpdeform.core.signed_distance import signed_distance
from cpdeform.core.state import initial_state
from cpdeform.placement.pose import GRASP_DIRECTIONS, turned
from cpdeform.placement.random import PlacerRandom
from cpdeform.placement.transport import PlacerTransport
from cpdeform.testing.placer import transport_of

IDENTITY = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=torch.float64)
SCALE = (0.01, 0.01, 0.01)
PLATE = {"half_extents": (0.015, 0.125, 0.06), "rounding": 0.01, "action_scale": SCALE}


def make_stage(bodies: list[dict[str, Any]], tools: list[ToolBase], peak: tuple[float, float, float]) -> Stage:
    """Priorities fall off with the distance to a peak."""
    scene = Scene(bodies=tuple(BodyBox(**body) for body in bodies), tools=tuple(tools))
    state = initial_state(scene, dtype=torch.float64)
    distance = (state.position[0] - torch.tensor(peak).to(state.position)).norm(dim=1)
    priorities = 0.03 * torch.exp(-((distance / 0.05) ** 2))
    generator = torch.Generator().manual_seed(0)
    return Stage(0, scene, state, state.position[0], transport_of(priorities - priorities.median()), generator, loss=1.0)


def block(**changes: Any) -> dict[str, Any]:
    return {"position": (0.5, 0.4, 0.5), "widths": (0.14, 0.1, 0.2), "particle_count": 3000} | changes


def plates() -> list[ToolBase]:
    return [ToolBox(position=(x, 0.4, 0.5), **PLATE) for x in (0.3, 0.7)]


def balls(*positions: tuple[float, float, float]) -> list[ToolBase]:
    return [ToolSphere(radius=0.03, position=position, action_scale=SCALE) for position in positions]


def gaps(stage: Stage, placement: Proposal) -> list[float]:
    tools = zip(stage.scene.tools, placement.pose, strict=True)
    return [float(signed_distance(tool, pose, stage.state.position[0]).min()) for tool, pose in tools]


def failed(placements: list[Proposal], loss: float) -> list[Candidate]:
    return [Candidate(placement, loss, torch.zeros(1, 6)) for placement in placements]


def test_plates_face_each_other_through_the_contact_point() -> None:
    stage = make_stage([block()], plates(), (0.55, 0.42, 0.45))
    placements = PlacerTransport().ask(stage)
    assert [placement.label for placement in placements] == list(GRASP_DIRECTIONS)
    contact = stage.state.position[0, int(stage.priorities.argmax())]
    for placement, direction in zip(placements, GRASP_DIRECTIONS.values(), strict=True):
        first, second = placement.pose[:, :3]
        axis = torch.tensor(direction).to(contact)
        apart = first - second
        assert float((apart - (apart @ axis) * axis).norm()) < 1e-9
        assert float((first - contact) @ axis) * float((second - contact) @ axis) < 0.0
        assert all(-1e-9 <= gap < 2e-5 for gap in gaps(stage, placement))
        # the broadest face presses: the thin side of both plates points along the direction
        thin = rotate(placement.pose[:, 3:7], torch.tensor([1.0, 0.0, 0.0]).to(contact))
        assert torch.allclose((thin @ axis).abs(), torch.ones(2).to(contact))
        # the contact point lies in front of the plate
        local = rotate(placement.pose[0, 3:7] * torch.tensor([1.0, -1.0, -1.0, -1.0]), contact - first)
        assert bool((local[1:].abs() <= torch.tensor([0.135, 0.07])).all())


def test_a_contact_point_beyond_the_bounds_is_faced_from_as_near_as_they_allow() -> None:
    low = [ball.model_copy(update={"upper_bound": (1.0, 0.36, 1.0)}) for ball in balls((0.3, 0.3, 0.5), (0.7, 0.3, 0.5))]
    stage = make_stage([block()], low, (0.55, 0.45, 0.45))
    placements = {placement.label: placement for placement in PlacerTransport().ask(stage)}
    contact = stage.state.position[0, int(stage.priorities.argmax())]
    assert float(contact[1]) > 0.36 + 0.03
    # Along y the bound keeps the second tool from the body's upper side.
    assert set(placements) == {"left-right", "front-back"}
    for label, axis in (("left-right", 2), ("front-back", 0)):
        pose = placements[label].pose
        assert torch.allclose(pose[:, 1], torch.tensor(0.36).to(pose), atol=1e-6)
        assert float((pose[:, axis] - contact[axis]).abs().max()) <= 0.03
        assert all(-1e-9 <= gap < 2e-5 for gap in gaps(stage, placements[label]))


def test_first_tool_takes_the_better_side() -> None:
    stage = make_stage([block(widths=(0.2, 0.1, 0.1))], plates(), (0.6, 0.4, 0.5))
    (placement,) = PlacerTransport(proposers=["left-right"]).ask(stage)
    assert placement.pose[0, 0] > 0.6 > 0.4 > placement.pose[1, 0]


def test_the_body_with_the_highest_mean_priority_comes_first() -> None:
    bodies = [
        block(position=(x, 0.05, 0.5), widths=(0.1, 0.1, 0.1), particle_count=count) for x, count in ((0.2, 2000), (0.7, 500))
    ]
    stage = make_stage(bodies, balls((0.4, 0.05, 0.3), (0.5, 0.05, 0.3)), (0.7, 0.05, 0.5))
    high = 0.001 + torch.zeros_like(stage.priorities)
    high[2000:] = 0.01
    high[5] = 0.02  # a single particle, the largest of all, in the body whose mean is low
    stage = dataclasses.replace(stage, transport=transport_of(high))
    placer = PlacerTransport()
    placements = placer.ask(stage)
    assert all(placement.contact_particle is not None and placement.contact_particle >= 2000 for placement in placements)
    assert all(float((placement.pose[:, 0] - 0.7).abs().max()) < 0.1 for placement in placements)
    # nothing improved: the other body is next, and there its largest priority
    assert placer.tell(failed(placements, loss=1.0))
    assert {placement.contact_particle for placement in placer.ask(stage)} == {5}


def test_pairs_share_out_the_bodies() -> None:
    bodies = [block(position=(x, 0.05, 0.5), widths=(0.1, 0.1, 0.1), particle_count=1000) for x in (0.3, 0.5, 0.7)]
    stage = make_stage(bodies, balls(*((0.1 * n, 0.3, 0.3) for n in range(1, 7))), (0.5, 0.05, 0.5))
    placements = PlacerTransport().ask(stage)
    front_back = next(placement for placement in placements if placement.label == "front-back")
    middles = sorted(front_back.pose[:, 0].reshape(3, 2).mean(dim=1).tolist())
    assert middles == pytest.approx([0.3, 0.5, 0.7], abs=0.08)
    tools = zip(stage.scene.tools, front_back.pose, strict=True)
    for number, (tool, pose) in enumerate(tools):
        others = torch.cat([front_back.pose[:number, :3], front_back.pose[number + 1 :, :3]])
        assert float(signed_distance(tool, pose, others).min()) >= 0.03


def test_explored_particles_are_not_proposed_again() -> None:
    stage = make_stage([block()], plates(), (0.55, 0.42, 0.45))
    placer, contacts = PlacerTransport(rounds=3), []
    for attempt in range(3):
        placements = placer.ask(stage)
        contacts.append(placements[0].contact_particle)
        assert placer.tell(failed(placements, loss=1.0)) == (attempt < 2)
    points = stage.state.position[0, torch.tensor(contacts)]
    assert torch.pdist(points).min() > 0.025
    # the contact points that failed are left out in the next stage, too; else it begins afresh
    for failures, expected in (((), contacts[0]), (tuple(contacts), None)):
        again = dataclasses.replace(stage, index=1, failed_contacts=failures)
        contact = placer.ask(again)[0].contact_particle
        assert contact == expected if expected is not None else contact not in contacts
    assert not placer.tell(failed(placements, loss=0.5))


def test_a_contact_point_out_of_reach_is_passed_over() -> None:
    tools = [ToolSphere(radius=0.03, position=(0.5, 0.6, 0.5), action_scale=SCALE, lower_bound=(0.0, 0.4, 0.0))]
    stage = make_stage([block()], tools, (0.5, 0.35, 0.5))
    (placement,) = PlacerTransport(rounds=1).ask(stage)
    # nor do tools that stay where they are stand in for it
    labels = [item.label for item in PlacerTransport(rounds=1, proposers=["current", "direct"]).ask(stage)]
    assert labels == ["current", "direct"]
    assert placement.contact_particle != int(stage.priorities.argmax())
    assert float(placement.pose[0, 1]) >= 0.4
    assert 0.0 <= gaps(stage, placement)[0] < 1e-3


def test_current_and_apart() -> None:
    stage = make_stage([block(widths=(0.4, 0.06, 0.06))], balls((0.2, 0.4, 0.5), (0.8, 0.4, 0.5)), (0.65, 0.4, 0.5))
    current, apart = PlacerTransport(proposers=["current", "apart"]).ask(stage)
    assert torch.equal(current.pose, stage.state.tool_pose[0])
    assert float((apart.pose[0, :3] - apart.pose[1, :3]).norm()) > 0.06
    assert all(0.0 <= gap < 1e-3 for gap in gaps(stage, apart))
    inside = stage.state.tool_pose.clone()
    inside[0, 0, 0] = 0.5
    moved = Stage(0, stage.scene, stage.state.with_tools(inside), stage.goal, stage.transport, stage.generator)
    assert [item.label for item in PlacerTransport(proposers=["current", "apart"]).ask(moved)] == ["apart"]


@pytest.mark.parametrize("proposers", [["sideways"], [], ["left-right", "left-right"]])
def test_unknown_proposers_are_named(proposers: list[str]) -> None:
    with pytest.raises(InputError, match=r"proposers: got .*left-right"):
        PlacerTransport(proposers=proposers)


@pytest.mark.parametrize("direction", GRASP_DIRECTIONS.values())
def test_a_box_turns_by_the_smallest_angle(direction: tuple[float, float, float]) -> None:
    quaternion = turned(plates()[0], torch.tensor(direction, dtype=torch.float64))
    assert float(quaternion.norm()) == pytest.approx(1.0)
    angle = 2.0 * float(torch.acos(quaternion[0].abs().clamp(max=1.0)))
    assert angle == pytest.approx(0.0 if direction[0] else torch.pi / 2)


def ball_exit(points: Tensor, start: Tensor, direction: Tensor, radius: float) -> Tensor:
    """Where the last of the intervals in which a ball holds points, all overlapping one another, ends."""
    offset = points - start
    along = offset @ direction
    across = (offset - along.unsqueeze(-1) * direction).square().sum(dim=-1)
    inside = across < radius**2
    half = (radius**2 - across[inside]).sqrt()
    return (along[inside] + half).max()


def test_exit_is_exact_for_a_ball() -> None:
    generator = torch.Generator().manual_seed(1)
    points = 0.1 * torch.rand(4000, 3, generator=generator, dtype=torch.float64)
    (tool,) = balls((0.0, 0.0, 0.0))
    starts = torch.tensor([[0.05, 0.05, 0.05], [0.02, 0.05, 0.08]], dtype=torch.float64)
    direction = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    found = exit_distances(tool, IDENTITY, starts, direction, points, reach=1.0)
    expected = torch.stack([ball_exit(points, start, direction, 0.03) for start in starts])
    assert bool((found >= expected).all())
    assert torch.allclose(found, expected, atol=1e-5)


def test_exit_does_not_pass_over_a_gap() -> None:
    generator = torch.Generator().manual_seed(1)
    points = 0.1 * torch.rand(8000, 3, generator=generator, dtype=torch.float64)
    points[4000:, 1] += 0.17  # a second block, 0.07 above the first one: wide enough for the ball of diameter 0.06
    (tool,) = balls((0.0, 0.0, 0.0))
    start, direction = torch.tensor([[0.05, 0.05, 0.05]]).double(), torch.tensor([0.0, 1.0, 0.0]).double()
    assert float(exit_distances(tool, IDENTITY, start, direction, points, reach=1.0)) == pytest.approx(0.08, abs=0.003)
    points[4000:, 1] -= 0.02
    assert float(exit_distances(tool, IDENTITY, start, direction, points, reach=1.0)) > 0.2
    assert not bool(exit_distances(tool, IDENTITY, start, direction, points, reach=0.1).isfinite())


def test_random_grasps_touch_and_follow_the_seed() -> None:
    stage = make_stage([block()], plates(), (0.55, 0.42, 0.45))
    placements = PlacerRandom(candidates=3).ask(stage)
    assert len(placements) == 3
    for placement in placements:
        assert all(-1e-9 <= gap < 2e-5 for gap in gaps(stage, placement))
    again = make_stage([block()], plates(), (0.55, 0.42, 0.45))
    assert torch.equal(placements[0].pose, PlacerRandom(candidates=1).ask(again)[0].pose)
    assert len({placement.contact_particle for placement in placements}) == 3
