"""`check_placer`: every registered placer passes, and each check catches one that is broken in its way."""

from __future__ import annotations

import pytest
import torch
from kit import assert_caught

from cpdeform.core.placer import Placer, PlacerCapabilities, Proposal
from cpdeform.core.plugins import load_registry
from cpdeform.core.signed_distance import signed_distance
from cpdeform.testing import check_placer
from cpdeform.testing.placer import PEAK, PLACER_CHECKS


def own_placers():
    """Placers of this package and of the example; other plugins check theirs."""
    registry = load_registry()
    own = ("cpdeform.", "cpdeform_example.")
    return [name for name in registry.names("placer") if registry.find("placer", name).spec.target.startswith(own)]


@pytest.mark.slow
@pytest.mark.parametrize("name", own_placers())
def test_registered_placers_pass(name):
    report = check_placer(load_registry().load("placer", name))
    report.raise_if_failed()
    assert len(report.checks) == len(PLACER_CHECKS)


class PlacerHover(Placer):
    """A correct placer, to be broken: the movable tools go as high as they may, where nothing else is."""

    capabilities = PlacerCapabilities(needs_priorities=False, max_tools=None)
    height = 0.2

    def pose(self, stage):
        pose = stage.state.tool_pose[0].clone()
        for index, tool in enumerate(stage.scene.tools):
            if tool.movable:
                pose[index, :3] = torch.tensor([PEAK[0] - 0.02, self.height, PEAK[2]])
                lower, upper = (torch.tensor(bound).to(pose) for bound in (tool.lower_bound, tool.upper_bound))
                pose[index, :3] = torch.minimum(torch.maximum(pose[index, :3], lower), upper)
        return pose

    def ask(self, stage):
        pose = self.pose(stage)
        collides = any(
            bool((signed_distance(tool, pose[index], stage.state.position[0]) < 0).any())
            for index, tool in enumerate(stage.scene.tools)
        )
        return [] if collides else [Proposal(pose, float("nan"), "hover")]


class PlacerNothing(PlacerHover):
    def ask(self, stage):
        return []


class PlacerOneTool(PlacerHover):
    def pose(self, stage):
        return super().pose(stage)[0]

    def ask(self, stage):
        return [Proposal(self.pose(stage), float("nan"), "flat")]


class PlacerColliding(PlacerHover):
    height = 0.1

    def ask(self, stage):
        return [Proposal(self.pose(stage), float("nan"), "inside")]


class PlacerOutside(PlacerHover):
    def pose(self, stage):
        pose = super().pose(stage)
        pose[:, 0] = 0.95
        return pose


class PlacerMovingAll(PlacerHover):
    def pose(self, stage):
        pose = super().pose(stage)
        pose[:, 1] += 0.01
        return pose


class PlacerOwnRandomness(PlacerHover):
    def pose(self, stage):
        pose = super().pose(stage)
        pose[:, 0] -= 0.1 * torch.rand(()).item()
        return pose


class PlacerWriting(PlacerHover):
    def pose(self, stage):
        stage.state.tool_pose[0] = super().pose(stage)
        return stage.state.tool_pose[0]


class PlacerSecretPriorities(PlacerHover):
    def pose(self, stage):
        pose = super().pose(stage)
        pose[:, 0] -= stage.priorities.abs().max()
        return pose


class PlacerEndless(PlacerHover):
    def tell(self, results):
        return True


BROKEN_PLACERS = {
    "finds a placement where there is room": PlacerNothing,
    "shapes and types of placements": PlacerOneTool,
    "no collision with the body": PlacerColliding,
    "tools within their bounds": PlacerOutside,
    "fixed tools stay": PlacerMovingAll,
    "reproducible by the generator": PlacerOwnRandomness,
    "stage is not modified": PlacerWriting,
    "proposes nothing where nothing is possible": PlacerColliding,
    "needs_priorities is honoured": PlacerSecretPriorities,
    "rounds end": PlacerEndless,
}


def test_every_check_of_placers_has_a_broken_one():
    assert set(BROKEN_PLACERS) == {item.name for item in PLACER_CHECKS}


def test_the_placer_that_is_broken_below_passes():
    check_placer(PlacerHover()).raise_if_failed()


@pytest.mark.parametrize("name", BROKEN_PLACERS)
def test_broken_placers_are_caught(name):
    assert_caught(check_placer(BROKEN_PLACERS[name], only=[name]), name)
