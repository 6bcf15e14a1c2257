"""A trajectory keeps what its way back needs to itself: callers use their buffers again."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import pytest
import torch
from backend_cases import BACKENDS, CASES, actions_for, backend_class, stirred
from torch import Tensor

from cpdeform.core.simulator import RolloutGradient, Trajectory
from cpdeform.core.state import State


def shift(state: State, actions: Tensor, trajectory: Trajectory) -> None:
    """What a search over start positions does; the particles then need other nodes of the grid."""
    state.position.add_(0.05)


def go_on(state: State, actions: Tensor, trajectory: Trajectory) -> None:
    """What a loop that steps one buffer does."""
    for field in dataclasses.fields(State):
        getattr(state, field.name).copy_(getattr(trajectory.final_state, field.name))


def act_again(state: State, actions: Tensor, trajectory: Trajectory) -> None:
    actions.neg_()


def centre(state: State, actions: Tensor, trajectory: Trajectory) -> None:
    """What somebody does who draws the result."""
    for tensor in (trajectory.positions, trajectory.tool_poses, trajectory.actions, trajectory.initial_state.position):
        tensor.sub_(tensor.mean(dim=-2, keepdim=True))
    trajectory.final_state.map(Tensor.zero_)


@pytest.mark.parametrize("memory_budget", [0, 1 << 29])
@pytest.mark.parametrize("write", [shift, go_on, act_again, centre])
@pytest.mark.parametrize("backend", BACKENDS)
def test_the_gradient_is_that_of_what_was_rolled_out(
    backend: str, write: Callable[[State, Tensor, Trajectory], None], memory_budget: int
) -> None:
    # `threads` and type so that nothing is converted, which would copy
    simulator = backend_class(backend)(CASES["two tools"], dtype=torch.float64, threads=1, memory_budget=memory_budget)

    def gradient(change: Callable[[State, Tensor, Trajectory], None] | None) -> RolloutGradient:
        state, actions = stirred(simulator).clone(), actions_for(simulator)
        trajectory = simulator.rollout(state, actions)
        weights = trajectory.positions.clone()
        if change is not None:
            change(state, actions, trajectory)
        return simulator.vjp(trajectory, weights, torch.ones(1, 3, 2, 8, dtype=torch.float64))

    expected, found = gradient(None), gradient(write)
    assert torch.equal(found.actions, expected.actions)
    for field in dataclasses.fields(State):
        assert torch.equal(getattr(found.initial_state, field.name), getattr(expected.initial_state, field.name)), field.name


@pytest.mark.parametrize("backend", BACKENDS)
def test_the_state_of_a_single_particle_is_no_part_of_the_checkpoints(backend: str) -> None:
    """Slices of an array of one particle count as contiguous, so that `contiguous` copies nothing."""
    body = {"kind": "box", "position": (0.5, 0.2, 0.5), "widths": (0.1, 0.1, 0.1), "particle_count": 1}
    alone = CASES["sphere"].model_validate({**CASES["sphere"].model_dump(), "bodies": [body]})
    simulator = backend_class(backend)(alone, dtype=torch.float64, threads=1)
    trajectory = simulator.rollout(stirred(simulator), actions_for(simulator))
    weights = torch.ones_like(trajectory.positions)
    expected = simulator.vjp(trajectory, weights)
    trajectory.final_state.map(lambda tensor: tensor.mul_(0.5))
    found = simulator.vjp(trajectory, weights)
    assert torch.equal(found.initial_state.position, expected.initial_state.position)
    assert torch.equal(found.initial_state.velocity, expected.initial_state.velocity)
