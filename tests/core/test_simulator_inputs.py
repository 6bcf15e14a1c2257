"""Numbers that a rollout cannot begin with are refused, by name and place; those that it can are not."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from cpdeform_toy.simulator import SimulatorToy

from cpdeform.core.errors import InputError
from cpdeform.core.scene import Scene
from cpdeform.core.simulator_inputs import POSITION_SLACK, QUATERNION_SLACK

BODY = {"kind": "box", "position": (0.5, 0.16, 0.5), "widths": (0.12, 0.1, 0.12), "particle_count": 20}
TOOL = {"kind": "Sphere", "radius": 0.03, "position": (0.5, 0.4, 0.5), "action_scale": (0.02, 0.02, 0.02)}
SCENE = Scene.model_validate({"bodies": [BODY], "tools": [TOOL], "grid_size": 32, "ground_height": 0.05})


@pytest.fixture
def simulator():
    return SimulatorToy(SCENE, batch_size=2)


def with_number(state, name, index, value):
    tensor = getattr(state, name).clone()
    tensor[index] = value
    return dataclasses.replace(state, **{name: tensor})


@pytest.mark.parametrize(
    ("name", "index", "value", "message"),
    [
        ("position", (1, 3, 2), math.nan, r"state.position: got 1 of 120 numbers .* nan \(world 1, particle 3, component 2\)"),
        ("position", (1, 3, 2), 1e6, r"state.position: got 1e\+06 \(world 1, particle 3, component 2\), .* from 0 to 0.90625"),
        ("position", (0, 0, 0), -0.2, r"state.position: got -0.2"),
        ("position", (1, 2, 1), 0.02, r"state.position: got 0.02 \(world 1, particle 2\), expected .* floor at y = 0.05"),
        ("velocity", (0, 7, 1), math.inf, r"state.velocity: got .* inf \(world 0, particle 7, component 1\).* diverges"),
        ("affine", (0, 7), math.nan, r"state.affine: got 9 of 360 numbers not finite"),
        ("elastic_strain", (0, 0, 5), -math.inf, r"state.elastic_strain: got .* -inf \(world 0, particle 0, component 5\)"),
        (
            "tool_pose",
            (1, 0, 0),
            1e6,
            r"state.tool_pose: got 1e\+06 \(world 1, tool 0, component 0\), .* from -100 to 101",
        ),
        ("tool_pose", (1, 0, 4), math.nan, r"state.tool_pose: got 1 of 2 numbers not finite.*\(world 1, tool 0\)"),
        ("tool_pose", (0, 0, slice(3, 7)), 0.0, r"state.tool_pose: got 0 \(world 0, tool 0\).* unit quaternions"),
        ("tool_pose", (0, 0, 3), 1.1, r"state.tool_pose: got 1.1 .* Divide them by their length"),
        ("tool_pose", (0, 0, 7), 40.0, r"state.tool_pose: got 40 .* gaps"),
    ],
)
def test_senseless_states_are_refused(simulator, name, index, value, message):
    state = with_number(simulator.initial_state(), name, index, value)
    with pytest.raises(InputError, match=message):
        simulator.rollout(state, torch.zeros(2, 3, 3))


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (math.nan, r"actions: got 1 of 18 numbers not finite, the first nan \(world 1, step 2, component 0\).* \[-1, 1\]"),
        (50.0, r"actions: got 50 \(world 1, step 2, component 0\), expected .* \[-1, 1\]\. .*action_scale"),
        (-1.001, r"actions: got -1.001"),
    ],
)
def test_senseless_actions_are_refused(simulator, value, message):
    actions = torch.zeros(2, 3, 3)
    actions[1, 2, 0] = value
    with pytest.raises(InputError, match=message):
        simulator.rollout(simulator.initial_state(), actions)


def test_rounding_and_the_bounds_themselves_pass(simulator):
    state = simulator.initial_state()
    (low, floor, _), (high, *_) = SCENE.domain
    slack = 0.9 * POSITION_SLACK * SCENE.node_distance
    for index, value in (((0, 0, 0), low - slack), ((0, 0, 1), floor - slack), ((1, 0, 2), high + slack)):
        state = with_number(state, "position", index, value)
    state = with_number(state, "tool_pose", (0, 0, slice(3, 7)), 0.5 * (1.0 + 0.9 * QUATERNION_SLACK))
    actions = torch.ones(2, 1, 3, dtype=torch.float64) * torch.tensor([1.0 + 1e-6, -1.0 - 1e-6, 1.0], dtype=torch.float64)
    simulator.check_inputs(state, actions)
    simulator.check_inputs(state, torch.ones(2, 1, 3, dtype=torch.float32, requires_grad=True))
    simulator.check_inputs(state, torch.ones(2, 1, 3, dtype=torch.int64))


def test_a_scene_without_tools_passes():
    simulator = SimulatorToy(SCENE.model_copy(update={"tools": ()}))
    simulator.check_inputs(simulator.initial_state(), torch.zeros(1, 2, 0))
