"""The simulator by itself: gradients from rest against finite differences, worlds, types, memory."""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest
import torch
from torch import Tensor

from cpdeform.core.errors import InputError
from cpdeform.core.scene import Scene
from cpdeform.core.simulator import differentiable_rollout
from cpdeform_example.simulator import SimulatorExample

FIELDS = ("position", "velocity", "affine", "elastic_strain", "tool_pose")


def scene(**changes: Any) -> Scene:
    body = {"kind": "box", "position": (0.5, 0.06, 0.5), "widths": (0.12, 0.1, 0.12), "particle_count": 80}
    capsule = {"kind": "Capsule", "radius": 0.03, "height": 0.06, "position": (0.47, 0.14, 0.5), "action_scale": (0.02,) * 6}
    return Scene.model_validate({"bodies": [body], "tools": [capsule], "grid_size": 32, "substeps": 3, **changes})


def plan(batch_size: int = 1, steps: int = 2) -> Tensor:
    generator = torch.Generator().manual_seed(1)
    return torch.rand(batch_size, steps, 6, generator=generator, dtype=torch.float64) - 0.5


def test_gradient_from_rest_equals_finite_differences() -> None:
    simulator, actions = SimulatorExample(scene()), plan()
    start = simulator.initial_state()

    def loss(plan: Tensor) -> Tensor:
        return differentiable_rollout(simulator, start, plan).positions[:, -1, :, 1].sum()

    actions.requires_grad_()
    loss(actions).backward()  # type: ignore[no-untyped-call]
    assert actions.grad is not None
    direction, step = torch.ones_like(actions), 1e-5
    with torch.no_grad():
        slope = float(loss(actions + step * direction) - loss(actions - step * direction)) / (2.0 * step)
    assert float((actions.grad * direction).sum()) == pytest.approx(slope, rel=1e-6)


@pytest.mark.parametrize("gravity", [0.0, -1.0])
def test_gradients_are_finite_from_rest_and_zero_without_contact(gravity: float) -> None:
    far = {"kind": "Box", "half_extents": (0.02,) * 3, "position": (0.5, 0.5, 0.5), "action_scale": (0.02,) * 6}
    simulator = SimulatorExample(scene(tools=[far], gravity_parameter=(0.0, gravity, 0.0)))
    trajectory = simulator.rollout(simulator.initial_state(), torch.zeros(1, 2, 6))
    gradient = simulator.vjp(trajectory, torch.ones_like(trajectory.positions))
    assert torch.equal(gradient.actions, torch.zeros_like(gradient.actions))
    for name in FIELDS:
        assert torch.isfinite(getattr(gradient.initial_state, name)).all(), name


def test_worlds_do_not_know_each_other_even_when_one_breaks() -> None:
    simulator, actions = SimulatorExample(scene(), batch_size=3), plan(3)
    whole = simulator.rollout(simulator.initial_state(), actions)
    alone = simulator.rollout(simulator.initial_state(batch_size=1), actions[2:])
    assert torch.allclose(whole.positions[2], alone.positions[0], atol=1e-14, rtol=0.0)
    state = simulator.initial_state()
    state.affine[0, 0] = 1e200  # finite, and the strain of the first substep is not
    broken = simulator.rollout(state, actions)
    assert torch.allclose(broken.positions[1:], whole.positions[1:], atol=1e-14, rtol=0.0)
    assert torch.isnan(broken.positions[0, -1]).any()


def test_rollout_repeats_bit_for_bit_and_continues_where_it_stopped() -> None:
    simulator, actions = SimulatorExample(scene()), plan(steps=3)
    whole = simulator.rollout(simulator.initial_state(), actions)
    assert torch.equal(whole.positions, simulator.rollout(simulator.initial_state(), actions).positions)
    first = simulator.rollout(simulator.initial_state(), actions[:, :1])
    assert torch.equal(whole.positions[:, 1:], simulator.rollout(first.final_state, actions[:, 1:]).positions)


def test_float32_follows_float64() -> None:
    results = []
    for dtype in (torch.float64, torch.float32):
        simulator = SimulatorExample(scene(), dtype=dtype)
        trajectory = simulator.rollout(simulator.initial_state(), plan())
        gradient = simulator.vjp(trajectory, torch.ones_like(trajectory.positions))
        assert trajectory.positions.dtype is gradient.actions.dtype is dtype
        results.append((trajectory.positions.double(), gradient.actions.double()))
    (positions, grad), (positions32, grad32) = results
    assert torch.allclose(positions, positions32, atol=1e-6, rtol=0.0)
    assert float((grad - grad32).norm() / grad.norm()) < 1e-2


def test_inputs_stay_and_unfit_gradients_are_refused() -> None:
    simulator, actions = SimulatorExample(scene()), plan()
    state = simulator.initial_state()
    before = state.clone()
    trajectory = simulator.rollout(state, actions)
    assert all(torch.equal(getattr(state, name), getattr(before, name)) for name in FIELDS)
    with pytest.raises(InputError, match="grad_positions"):
        simulator.vjp(trajectory, torch.zeros(1, 2, 80, 3))
    with pytest.raises(InputError, match="without checkpoints"):
        simulator.vjp(dataclasses.replace(trajectory, checkpoints=None), torch.zeros_like(trajectory.positions))


@pytest.mark.parametrize("count", [40, 400])
def test_memory_estimate_bounds_the_graph(count: int) -> None:
    body = {"kind": "box", "position": (0.5, 0.06, 0.5), "widths": (0.12, 0.1, 0.12), "particle_count": count}
    simulator = SimulatorExample(scene(bodies=[body]))
    kept: dict[int, Tensor] = {}

    def keep(tensor: Tensor) -> Tensor:
        kept[tensor.untyped_storage().data_ptr()] = tensor
        return tensor

    start = simulator.initial_state().map(lambda tensor: tensor.requires_grad_())
    with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
        simulator._step(start, plan()[:, 0].requires_grad_())
    measured = sum(tensor.untyped_storage().nbytes() for tensor in kept.values())
    assert measured < simulator.memory_estimate(1) < 2.5 * measured
