"""Rollouts that go on from each other's final state carry gradients through all of it."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from backend_cases import BACKENDS, CASES, ORACLE, actions_for, backend_class, simulator_class, stirred

from cpdeform.core.errors import CapabilityError, InputError
from cpdeform.core.simulator import Simulator, Trajectory, differentiable_rollout
from cpdeform.core.state import State

FIELDS = tuple(field.name for field in dataclasses.fields(State))


@pytest.fixture(params=[*BACKENDS, "example"])
def simulator(request: pytest.FixtureRequest) -> Simulator:
    found = simulator_class(*ORACLE) if request.param == "example" else backend_class(request.param)
    return found(CASES["two tools"], dtype=torch.float64, batch_size=2)


def loss_of(trajectory: Trajectory) -> torch.Tensor:
    """A loss on the whole final state, other for each number."""
    total = trajectory.positions[:, -1].square().sum()
    for index, name in enumerate(FIELDS):
        value = getattr(trajectory.final_state, name)
        total = total + (value * torch.linspace(-1.0, 1.0 + index, value.numel(), dtype=value.dtype).view_as(value)).sum()
    return total


def test_a_loop_of_single_steps_has_the_gradient_of_one_rollout(simulator: Simulator) -> None:
    start, plan = stirred(simulator, batch_size=2), actions_for(simulator, batch_size=2, steps=3)
    whole_plan, whole_start = plan.clone().requires_grad_(), start.map(lambda tensor: tensor.clone().requires_grad_())
    loss_of(differentiable_rollout(simulator, whole_start, whole_plan)).backward()
    loop_plan, loop_start = plan.clone().requires_grad_(), start.map(lambda tensor: tensor.clone().requires_grad_())
    state = loop_start
    for step in range(3):
        trajectory = differentiable_rollout(simulator, state, loop_plan[:, step : step + 1])
        state = trajectory.final_state
    loss_of(trajectory).backward()
    assert torch.allclose(loop_plan.grad, whole_plan.grad, rtol=1e-9, atol=1e-12)
    for name in FIELDS:
        found, expected = getattr(loop_start, name).grad, getattr(whole_start, name).grad
        assert torch.allclose(found, expected, rtol=1e-7, atol=1e-10), name
        assert expected.abs().max() > 0.0, name


def test_simulating_without_a_way_back_gives_the_numbers_of_a_rollout(simulator: Simulator) -> None:
    start, plan = stirred(simulator, batch_size=2), actions_for(simulator, batch_size=2, steps=2)
    whole, alone = simulator.rollout(start, plan), simulator.simulate(start, plan)
    assert alone.checkpoints is None
    assert torch.equal(alone.positions, whole.positions)
    assert torch.equal(alone.tool_poses, whole.tool_poses)
    for name in FIELDS:
        assert torch.equal(getattr(alone.final_state, name), getattr(whole.final_state, name)), name


def test_a_final_gradient_of_zeros_changes_nothing_and_another_shape_is_named(simulator: Simulator) -> None:
    trajectory = simulator.rollout(stirred(simulator, batch_size=2), actions_for(simulator, batch_size=2))
    weights = trajectory.positions.clone()
    zeros = trajectory.final_state.map(torch.zeros_like)
    expected, found = simulator.vjp(trajectory, weights), simulator.vjp(trajectory, weights, grad_final_state=zeros)
    assert torch.equal(found.actions, expected.actions)
    for name in FIELDS:
        assert torch.equal(getattr(found.initial_state, name), getattr(expected.initial_state, name)), name
    with pytest.raises(InputError, match=r"grad_final_state.position: got shape \(1, 300, 3\), expected shape \(2, 300, 3\)"):
        simulator.vjp(trajectory, weights, grad_final_state=zeros.select(0))
    with pytest.raises(InputError, match="grad_tools"):
        simulator.vjp(trajectory, weights, trajectory.tool_poses[:, 1:])


def test_what_vjp_is_given_stays_as_it_is(simulator: Simulator) -> None:
    trajectory = simulator.rollout(stirred(simulator, batch_size=2), actions_for(simulator, batch_size=2))
    given = trajectory.positions.clone(), trajectory.tool_poses.clone(), trajectory.final_state.clone()
    simulator.vjp(trajectory, given[0], given[1], grad_final_state=given[2])
    assert torch.equal(given[0], trajectory.positions)
    assert torch.equal(given[1], trajectory.tool_poses)
    for name in FIELDS:
        assert torch.equal(getattr(given[2], name), getattr(trajectory.final_state, name)), name


def old_backend() -> Simulator:
    """A backend whose `vjp` was written before it was given the gradient of the final state."""

    class SimulatorOld(backend_class("warp")):
        def vjp(self, trajectory, grad_positions, grad_tools=None):
            return super().vjp(trajectory, grad_positions, grad_tools)

    return SimulatorOld(CASES["two tools"], dtype=torch.float64)


def test_an_old_backend_serves_for_losses_on_positions_and_tools() -> None:
    simulator, plan = old_backend(), actions_for(old_backend())
    gradients = []
    for end in (False, True):
        actions = plan.clone().requires_grad_()
        trajectory = differentiable_rollout(simulator, stirred(simulator), actions)
        at = trajectory.final_state if end else State(
            trajectory.positions[:, -1], *(getattr(trajectory.final_state, name) for name in FIELDS[1:-1]),
            trajectory.tool_poses[:, -1],
        )  # fmt: skip
        (at.position.square().sum() + at.tool_pose.square().sum()).backward()
        gradients.append(actions.grad)
    assert torch.allclose(*gradients, rtol=1e-12)
    assert gradients[0].abs().max() > 0.0


def test_an_old_backend_says_that_it_has_no_chain() -> None:
    simulator, actions = old_backend(), actions_for(old_backend()).requires_grad_()
    first = differentiable_rollout(simulator, stirred(simulator), actions)
    second = differentiable_rollout(simulator, first.final_state, actions)
    with pytest.raises(CapabilityError, match=r"SimulatorOld has no gradient .* grad_final_state"):
        second.positions.sum().backward()
    # what the message advises
    alone = differentiable_rollout(simulator, first.final_state.clone(), actions)
    alone.positions.sum().backward()
    assert actions.grad is not None


def test_a_second_derivative_is_refused() -> None:
    simulator = backend_class("warp")(CASES["sphere"])
    actions = actions_for(simulator).requires_grad_()
    loss = differentiable_rollout(simulator, stirred(simulator), actions).positions.square().sum()
    (gradient,) = torch.autograd.grad(loss, actions, create_graph=True)
    with pytest.raises(RuntimeError, match="differentiate twice"):
        gradient.square().sum().backward()
