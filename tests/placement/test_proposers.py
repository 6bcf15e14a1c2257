"""Proposers: variations near a proposal, first actions, names."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from cpdeform.core.errors import InputError
from cpdeform.core.signed_distance import signed_distance
from cpdeform.placement.proposers.names import default_proposers, make_proposers
from cpdeform.placement.transport import PlacerTransport
from cpdeform.testing.placer import make_stage


def proposal():
    (found,) = PlacerTransport().ask(make_stage())
    return dataclasses.replace(found, actions=torch.tensor([0.0, -0.9, 0.0]).repeat(4, 1))


def test_variations_are_near_and_free_of_collision() -> None:
    stage, first = make_stage(), proposal()
    (proposer,) = make_proposers("direct")
    varied = [found for _ in range(60) if (found := proposer.vary(first, stage, scale=0.01)) is not None]
    # The tool touches the block: about half of all shifts lead into it.
    assert 10 < len(varied) < 50
    shifts = torch.stack([item.pose[0, :3] - first.pose[0, :3] for item in varied])
    assert 0.004 < float(shifts.std()) < 0.02
    tool = stage.scene.tools[0]
    for item in varied:
        assert float(signed_distance(tool, item.pose[0], stage.state.position[0]).min()) >= -1e-4
        assert torch.equal(item.pose[:, 3:], first.pose[:, 3:])
        assert item.label == first.label
        assert item.actions is not None
        assert float(item.actions.abs().max()) <= 1.0
    assert len({tuple(item.actions.flatten().tolist()) for item in varied if item.actions is not None}) == len(varied)
    assert [proposer.vary(first, make_stage(), scale=0.01) is None for _ in range(2)] == [
        proposer.vary(first, make_stage(), scale=0.01) is None for _ in range(2)
    ]


def test_a_variation_beyond_the_bounds_is_none() -> None:
    stage, first = make_stage(upper_bound=(0.55, 0.9, 0.5)), proposal()
    outside = first.pose.clone()
    outside[0, 2] = 0.7
    (proposer,) = make_proposers("direct")
    assert all(proposer.vary(dataclasses.replace(first, pose=outside), stage, scale=0.01) is None for _ in range(20))


def test_names_and_objects_mix() -> None:
    (direct,) = make_proposers("direct")
    assert [item.name for item in make_proposers(["current", direct])] == ["current", "direct"]
    assert [item.name for item in default_proposers(1)] == ["direct"]
    assert [item.name for item in default_proposers(3)] == ["left-right", "top-bottom", "front-back"]
    with pytest.raises(InputError, match="proposers: got direct, direct, expected distinct names"):
        make_proposers(["direct", direct])
