"""The placer that moves nothing, and the registration of all of them."""

from __future__ import annotations

import importlib
import math

import torch

from cpdeform.core.placer import Placer, Stage
from cpdeform.core.scene import BodyBox, Scene, ToolSphere
from cpdeform.core.state import initial_state
from cpdeform.placement.fixed import PlacerFixed
from cpdeform.placement.plugin import cpdeform_placers


def test_tools_stay_even_in_collision() -> None:
    scene = Scene(
        bodies=(BodyBox(position=(0.5, 0.4, 0.5), widths=(0.2, 0.2, 0.2), particle_count=50),),
        tools=tuple(ToolSphere(position=(x, 0.4, 0.5), radius=0.05, action_scale=(1.0,) * 3) for x in (0.4, 0.6)),
    )
    state = initial_state(scene)
    stage = Stage(0, scene, state, state.position[0], None, torch.Generator())
    (placement,) = PlacerFixed().ask(stage)
    assert torch.equal(placement.pose, state.tool_pose[0])
    assert placement.pose.data_ptr() != state.tool_pose.data_ptr()
    assert math.isnan(placement.score)
    assert placement.contact_particle is None


def test_registered_placers_exist() -> None:
    specs = cpdeform_placers()
    assert [spec.name for spec in specs] == ["transport", "touch", "fixed", "random"]
    for spec in specs:
        module, attribute = spec.target.split(":")
        assert issubclass(getattr(importlib.import_module(module), attribute), Placer)
