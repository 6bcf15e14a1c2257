"""The random placer: surface, contact, seeds."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from cpdeform.core.errors import InputError
from cpdeform.core.placer import Candidate, Proposal, Stage
from cpdeform.core.scene import BodyBox, BodySphere, Scene, ToolSphere
from cpdeform.core.signed_distance import signed_distance
from cpdeform.core.state import initial_state
from cpdeform.placement.random import PlacerRandom, surface_particles


def stage(seed: int = 0) -> Stage:
    scene = Scene(
        bodies=(BodyBox(position=(0.5, 0.4, 0.5), widths=(0.2, 0.2, 0.2), particle_count=3000),),
        tools=(ToolSphere(position=(0.5, 0.7, 0.5), radius=0.03, action_scale=(0.01, 0.01, 0.01)),),
    )
    state = initial_state(scene)
    return Stage(0, scene, state, state.position[0], None, torch.Generator().manual_seed(seed))


def poses(placements: list[Proposal]) -> torch.Tensor:
    return torch.stack([placement.pose for placement in placements])


def test_tools_touch_near_their_particle_without_collision() -> None:
    here = stage()
    placements = PlacerRandom(candidates=6).ask(here)
    assert [placement.label for placement in placements] == [f"random-{number}" for number in range(1, 7)]
    for placement in placements:
        gap = signed_distance(here.scene.tools[0], placement.pose[0], here.state.position[0])
        assert -1e-6 <= float(gap.min()) <= 5e-4
        assert placement.contact_particle is not None
        assert float(gap[placement.contact_particle]) < 0.02


def test_the_stages_generator_decides() -> None:
    first, again, other = (PlacerRandom(candidates=3).ask(stage(seed)) for seed in (1, 1, 2))
    assert torch.equal(poses(first), poses(again))
    assert not torch.equal(poses(first), poses(other))
    assert len({placement.contact_particle for placement in first}) == 3


def test_other_particles_are_drawn_until_one_lowers_the_loss() -> None:
    here = dataclasses.replace(stage(), loss=1.0)
    placer = PlacerRandom(rounds=3)
    contacts = []
    for again in (True, True, False):
        placements = placer.ask(here)
        contacts += [placement.contact_particle for placement in placements]
        assert placer.tell([Candidate(placement, 1.0, torch.zeros(1, 3)) for placement in placements]) is again
    assert len(set(contacts)) == 3
    placements = placer.ask(dataclasses.replace(stage(), loss=1.0))
    assert placer.tell([Candidate(placements[0], float("nan"), torch.zeros(1, 3), False)]) is True
    assert placer.tell([Candidate(placements[0], 0.9, torch.zeros(1, 3))]) is False


def test_surface_particles_are_those_near_the_faces() -> None:
    position = stage().state.position[0]
    surface = surface_particles(position)
    depth = (0.1 - (position - torch.tensor([0.5, 0.4, 0.5])).abs()).amin(dim=-1)
    assert float(depth[surface].max()) < 0.035
    assert float((depth[surface] < 0.02).float().mean()) > 0.95
    outermost = torch.nonzero(depth < 0.004).flatten()
    assert float(torch.isin(outermost, surface).float().mean()) > 0.97


def test_surface_of_a_ball_and_of_few_particles() -> None:
    scene = Scene(bodies=(BodySphere(position=(0.5, 0.5, 0.5), radius=0.2, particle_count=4000),))
    position = initial_state(scene).position[0]
    radius = (position - 0.5).norm(dim=-1)
    surface = surface_particles(position)
    assert float(radius[surface].quantile(0.05)) > 0.16
    assert surface_particles(position[:1]).tolist() == [0]
    assert surface_particles(position[:5]).tolist() == [0, 1, 2, 3, 4]


def test_gives_up_where_nothing_can_be_touched() -> None:
    here = stage()
    tool = here.scene.tools[0].model_copy(update={"lower_bound": (0.0, 0.8, 0.0)})
    object.__setattr__(here, "scene", here.scene.model_copy(update={"tools": (tool,)}))
    assert PlacerRandom(candidates=2, draws=3).ask(here) == []


@pytest.mark.parametrize("name", ["candidates", "draws", "rounds"])
def test_options_are_checked(name: str) -> None:
    with pytest.raises(InputError, match=f"{name}: got 0"):
        PlacerRandom(**{name: 0})
