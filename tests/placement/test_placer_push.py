"""Tools behind the clay that has to move: a rope whose parts have to go different ways."""

from __future__ import annotations

import dataclasses
import itertools
from typing import Any

import pytest
import torch
from torch import Tensor

from cpdeform.core.errors import InputError
from cpdeform.core.placer import Candidate, Stage
from cpdeform.core.rotation import rotate
from cpdeform.core.scene import BodyBox, Scene, ToolBox, ToolSphere
from cpdeform.core.signed_distance import signed_distance
from cpdeform.core.state import initial_state
from cpdeform.placement.push import PushSearch
from cpdeform.placement.transport import PlacerTransport
from cpdeform.testing.placer import transport_of

SCALE = (0.01, 0.01, 0.01)


def ball(**changes: Any) -> ToolSphere:
    return ToolSphere(**{"radius": 0.03, "position": (0.5, 0.3, 0.2), "action_scale": SCALE} | changes)


def rope(tools: list[Any], *, count: int = 3000) -> Stage:
    """The rope's left part has to go to the front, by at most 0.09, its right part back, by at most 0.06; the middle stays."""
    scene = Scene(bodies=(BodyBox(position=(0.5, 0.03, 0.5), widths=(0.6, 0.06, 0.06), particle_count=count),), tools=tuple(tools))
    state = initial_state(scene, dtype=torch.float64)
    x = state.position[0, :, 0]
    aside = 0.09 * torch.exp(-(((x - 0.34) / 0.07) ** 2)) - 0.06 * torch.exp(-(((x - 0.7) / 0.07) ** 2))
    displacements = torch.stack([torch.zeros_like(x), torch.zeros_like(x), aside], dim=1)
    generator = torch.Generator().manual_seed(0)
    return Stage(0, scene, state, state.position[0], transport_of(aside.abs(), displacements), generator, loss=1.0)


def gaps(stage: Stage, poses: Tensor) -> list[float]:
    tools = zip(stage.scene.tools, poses, strict=True)
    return [float(signed_distance(tool, pose, stage.state.position[0]).min()) for tool, pose in tools]


def test_each_tool_stands_behind_the_clay_that_it_is_to_move() -> None:
    stage = rope([ball(), ball(position=(0.7, 0.3, 0.2))])
    (placement,) = PlacerTransport(proposers=["push"]).ask(stage)
    left, right = placement.pose[:, :3].tolist()
    assert left == pytest.approx([0.34, 0.03, 0.44], abs=0.015)
    assert right == pytest.approx([0.70, 0.03, 0.56], abs=0.015)
    assert all(-1e-9 <= gap < 2e-5 for gap in gaps(stage, placement.pose))
    assert placement.label == "push"
    assert placement.contact_particle is not None
    assert float(stage.state.position[0, placement.contact_particle, 0]) == pytest.approx(0.34, abs=0.015)


def test_score_is_the_papers_of_the_displacements() -> None:
    stage = rope([ball()], count=400)
    (placement,) = PlacerTransport(proposers=["push"], distance_scale=0.05).ask(stage)
    particles, displacements = stage.state.position[0], stage.displacements
    assert displacements is not None
    scores = [
        sum(u / ((float((x - p).norm()) / 0.05) ** 2 + 1) for x, u in zip(particles, displacements, strict=True)) / len(particles)
        for p in particles
    ]
    norms = torch.stack([torch.linalg.vector_norm(score) for score in scores])  # type: ignore[arg-type]
    assert placement.contact_particle == int(norms.argmax())
    assert placement.score == pytest.approx(float(norms.max()))


def test_turning_the_world_turns_the_pushes() -> None:
    stage = rope([ball()], count=1000)
    assert stage.displacements is not None
    quarter = torch.tensor([0.5**0.5, 0.0, 0.5**0.5, 0.0], dtype=torch.float64)
    everywhere = torch.ones(1000, dtype=torch.bool)

    def pushes(points: Tensor, displacements: Tensor) -> list[Any]:
        search = PushSearch(tools=stage.scene.tools, particles=points, displacements=displacements, distance_scale=0.03)
        found = []
        for _ in range(3):
            push = search.next(everywhere)
            assert push is not None
            search.take_off(push)
            found.append(push)
        return found

    straight = pushes(stage.state.position[0], stage.displacements)
    turned = pushes(rotate(quarter, stage.state.position[0]), rotate(quarter, stage.displacements))
    for one, other in zip(straight, turned, strict=True):
        assert one.contact == other.contact
        assert one.score == pytest.approx(other.score)
        assert torch.allclose(rotate(quarter, one.direction), other.direction)


def test_noise_does_not_count() -> None:
    stage = rope([ball()])
    assert stage.displacements is not None
    still = stage.state.position[0, :, 0] < 0.5
    noise = 0.12 * torch.randn(stage.displacements.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    noisy = torch.where(still.unsqueeze(-1), noise, stage.displacements)
    stage = dataclasses.replace(stage, transport=transport_of(noisy.norm(dim=1), noisy))
    (placement,) = PlacerTransport(proposers=["push"]).ask(stage)
    assert float(stage.state.position[0, int(stage.priorities.argmax()), 0]) < 0.5
    assert placement.pose[0, :3].tolist() == pytest.approx([0.70, 0.03, 0.56], abs=0.02)


def test_several_contact_points_are_near_each_other_and_not_the_same() -> None:
    stage = rope([ball(), ball(position=(0.7, 0.3, 0.2))])
    placer = PlacerTransport(proposers=["push"], contacts=3, rounds=2)
    placements = placer.ask(stage)
    assert len(placements) == 3
    lefts = sorted(float(placement.pose[:, 0].min()) for placement in placements)
    assert all(0.02 < second - first < 0.06 for first, second in itertools.pairwise(lefts))
    results = [Candidate(placement, 1.0, torch.zeros(1, 6)) for placement in placements]
    assert placer.tell(results)
    again = placer.ask(stage)
    assert not {placement.contact_particle for placement in placements} & {placement.contact_particle for placement in again}


def test_a_tool_that_may_not_rise_or_sink_stays_level() -> None:
    tool = ball(position=(0.5, 0.015, 0.2), lower_bound=(0.0, 0.01, 0.0), upper_bound=(1.0, 0.02, 1.0))
    stage = rope([tool])
    assert stage.displacements is not None
    down = stage.displacements - torch.tensor([0.0, 0.05, 0.0]).to(stage.displacements)
    stage = dataclasses.replace(stage, transport=transport_of(stage.priorities, down))
    (placement,) = PlacerTransport(proposers=["push"]).ask(stage)
    assert 0.01 <= float(placement.pose[0, 1]) <= 0.02
    assert float(placement.pose[0, 2]) < 0.45
    assert -1e-9 <= gaps(stage, placement.pose)[0] < 2e-5


def test_a_plate_presses_its_broad_face() -> None:
    plate = ToolBox(position=(0.5, 0.4, 0.2), half_extents=(0.01, 0.03, 0.03), rounding=0.005, action_scale=SCALE)
    stage = rope([plate])
    (placement,) = PlacerTransport(proposers=["push"]).ask(stage)
    thin = rotate(placement.pose[0, 3:7], torch.tensor([1.0, 0.0, 0.0]).to(placement.pose))
    assert abs(float(thin[2])) == pytest.approx(1.0, abs=1e-3)
    assert float(placement.pose[0, 2]) < 0.47


def test_no_room_is_no_placement() -> None:
    away = ball(position=(0.5, 0.5, 0.2), lower_bound=(0.0, 0.4, 0.0))
    assert PlacerTransport(proposers=["push"], contacts=4).ask(rope([away])) == []
    still = rope([ball()])
    assert still.displacements is not None
    still = dataclasses.replace(still, transport=transport_of(still.priorities, torch.zeros_like(still.displacements)))
    assert PlacerTransport(proposers=["push"]).ask(still) == []


def test_pushes_stand_beside_other_candidates() -> None:
    stage = rope([ball(), ball(position=(0.7, 0.3, 0.2))])
    placements = PlacerTransport(proposers=["push", "front-back", "current"]).ask(stage)
    assert [placement.label for placement in placements] == ["push", "front-back", "current"]


def test_pushes_need_displacements() -> None:
    stage = rope([ball()])
    stage = dataclasses.replace(stage, transport=transport_of(stage.priorities))
    with pytest.raises(InputError, match=r"a solution of the cost \|x - y\|\^1, .*\(--set priorities\.kind=displacement\)"):
        PlacerTransport(proposers=["push"]).ask(stage)


def test_the_placer_declares_the_problem_that_its_proposers_read() -> None:
    assert PlacerTransport(proposers=["current", "push"]).transport_problem.exponent == 2
    assert PlacerTransport(proposers=["current", "direct"]).transport_problem.exponent == 1
    assert PlacerTransport().transport_problem.exponent == 1
