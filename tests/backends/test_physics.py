"""Physics of the backends: conservation, closed forms, symmetry, yield, and gradients against finite differences."""

from __future__ import annotations

import dataclasses
import math
import multiprocessing
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor

import pytest
import torch
from backend_cases import BACKENDS, CASES, STEPS, actions_for, backend_class, floating, positions_and_gradient, scene, stirred, tool
from torch import Tensor

from cpdeform.core.errors import CapabilityError, InputError
from cpdeform.core.simulator import Simulator, differentiable_rollout
from cpdeform.core.state import State

Backend = Callable[..., Simulator]


@pytest.fixture(params=BACKENDS)
def backend(request: pytest.FixtureRequest) -> Backend:
    return backend_class(request.param)


@pytest.mark.parametrize("name", CASES)
def test_gradients_equal_central_differences(backend: Backend, name: str) -> None:
    simulator = backend(CASES[name], dtype=torch.float64, batch_size=2)
    generator = torch.Generator().manual_seed(2)
    state, actions = stirred(simulator, batch_size=2), actions_for(simulator, batch_size=2)
    trajectory = simulator.rollout(state, actions)

    def noise(like: Tensor) -> Tensor:
        return torch.randn(like.shape, generator=generator, dtype=torch.float64)

    weights, pose_weights = noise(trajectory.positions), noise(trajectory.tool_poses)
    gradient = simulator.vjp(trajectory, weights, pose_weights)

    def loss(start: State, plan: Tensor) -> float:
        result = simulator.rollout(start, plan)
        return float((result.positions * weights).sum() + (result.tool_poses * pose_weights).sum())

    def compare(expected: float, found: Tensor, direction: Tensor, name: str) -> None:
        scale = float(found.norm() * direction.norm()) / math.sqrt(direction.numel())
        assert float((found * direction).sum()) == pytest.approx(expected, abs=2e-4 * scale + 1e-9), name

    direction, step = noise(actions), 1e-6
    slope = (loss(state, actions + step * direction) - loss(state, actions - step * direction)) / (2 * step)
    compare(slope, gradient.actions, direction, "actions")
    for field, step in STEPS.items():
        value = getattr(state, field)
        direction = noise(value)
        up = dataclasses.replace(state, **{field: value + step * direction})
        down = dataclasses.replace(state, **{field: value - step * direction})
        compare((loss(up, actions) - loss(down, actions)) / (2 * step), getattr(gradient.initial_state, field), direction, field)


def test_gradients_are_finite_from_rest_and_without_contact(backend: Backend) -> None:
    far = tool("Capsule", position=(0.5, 0.4, 0.5), rotation_wxyz=(1.0, 0.0, 0.0, 0.0))
    for gravity in ((0.0, 0.0, 0.0), (0.0, -1.0, 0.0)):
        simulator = backend(scene(far, gravity_parameter=gravity))
        trajectory = simulator.rollout(simulator.initial_state(), torch.zeros(1, 2, 6))
        gradient = simulator.vjp(trajectory, torch.ones_like(trajectory.positions))
        assert torch.isfinite(gradient.actions).all()
        assert torch.equal(gradient.actions, torch.zeros_like(gradient.actions))
        for name in ("position", "velocity", "affine", "elastic_strain", "tool_pose"):
            assert torch.isfinite(getattr(gradient.initial_state, name)).all(), name


def test_float32_follows_float64(backend: Backend) -> None:
    results = []
    for dtype in (torch.float32, torch.float64):
        simulator = backend(CASES["capsule, sticky floor"], dtype=dtype)
        state = simulator.initial_state()
        trajectory = simulator.rollout(state, actions_for(simulator))
        gradient = simulator.vjp(trajectory, torch.ones_like(trajectory.positions)).actions.double()
        results.append((trajectory.positions.double(), gradient))
    (single, single_gradient), (double, double_gradient) = results
    assert (single - double).abs().max() < 1e-5
    assert torch.nn.functional.cosine_similarity(single_gradient.flatten(), double_gradient.flatten(), dim=0) > 0.9999


def test_momentum_is_conserved_without_external_forces(backend: Backend) -> None:
    simulator = backend(floating(), dtype=torch.float64)
    state = stirred(simulator)
    final = simulator.rollout(state, torch.zeros(1, 3, 0)).final_state
    assert torch.allclose(final.velocity.sum(dim=1), state.velocity.sum(dim=1), atol=1e-10)


def test_angular_momentum_is_conserved_without_external_forces(backend: Backend) -> None:
    simulator = backend(floating(), dtype=torch.float64)
    state = stirred(simulator)

    def angular_momentum(moment: State) -> Tensor:
        # APIC particles carry spin in the affine field C: the stencil's second moment is dx^2/4
        spin = 0.25 * simulator.scene.node_distance**2
        c = moment.affine
        own = spin * torch.stack([c[..., 2, 1] - c[..., 1, 2], c[..., 0, 2] - c[..., 2, 0], c[..., 1, 0] - c[..., 0, 1]], dim=-1)
        return (torch.linalg.cross(moment.position, moment.velocity) + own).sum(dim=1)

    # positions move with the velocity after a substep, torque-free to the order of the substep
    final = simulator.rollout(state, torch.zeros(1, 3, 0)).final_state
    assert torch.allclose(angular_momentum(final), angular_momentum(state), rtol=1e-6, atol=1e-6)


def test_free_fall_has_the_closed_form(backend: Backend) -> None:
    simulator = backend(floating(gravity_parameter=(0.0, -1.0, 0.0)), dtype=torch.float64)
    state = simulator.initial_state()
    steps = 4
    final = simulator.rollout(state, torch.zeros(1, steps, 0)).final_state
    count, time_step = steps * simulator.scene.substeps, simulator.scene.time_step
    assert torch.allclose(final.velocity[..., 1], torch.full_like(final.velocity[..., 1], -30.0 * count * time_step), atol=1e-9)
    fallen = state.position[..., 1] - final.position[..., 1]
    assert torch.allclose(fallen, torch.full_like(fallen, 30.0 * time_step**2 * count * (count + 1) / 2), atol=1e-9)


def test_physics_does_not_depend_on_the_axis(backend: Backend) -> None:
    """Swapping x and z of the world swaps them in the result."""
    simulator = backend(floating(), dtype=torch.float64)
    state, swap = stirred(simulator), [2, 1, 0]
    strain_swap = [2, 1, 0, 5, 4, 3]
    swapped = State(
        state.position[..., swap],
        state.velocity[..., swap],
        state.affine[..., swap, :][..., swap],
        state.elastic_strain[..., strain_swap],
        state.tool_pose,
    )
    plain = simulator.rollout(state, torch.zeros(1, 2, 0)).final_state
    other = simulator.rollout(swapped, torch.zeros(1, 2, 0)).final_state
    assert torch.allclose(other.position[..., swap], plain.position, atol=1e-12)
    assert torch.allclose(other.elastic_strain[..., strain_swap], plain.elastic_strain, atol=1e-10)


def test_stress_never_leaves_the_yield_surface(backend: Backend) -> None:
    simulator = backend(CASES["sphere"], dtype=torch.float64)
    pressing = torch.zeros(1, 4, 3)
    pressing[..., 1] = -1.0
    strain = simulator.rollout(stirred(simulator), pressing).final_state.elastic_strain
    xx, yy, zz, xy, xz, yz = strain.unbind(-1)
    matrix = torch.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], dim=-1).reshape(-1, 3, 3)
    hencky = 0.5 * torch.log1p(torch.linalg.eigvalsh(matrix))
    deviator = (hencky - hencky.mean(dim=-1, keepdim=True)).norm(dim=-1)
    material = simulator.scene.material
    limit = material.yield_stress / (2 * material.shear_modulus)
    assert deviator.max() <= limit * (1 + 1e-6)
    assert deviator.max() > 0.99 * limit  # the press did make clay flow


def test_pressed_clay_gives_way_and_keeps_out_of_the_tool(backend: Backend) -> None:
    simulator = backend(scene(tool("Sphere", position=(0.5, 0.142, 0.5)), grid_size=64, substeps=19))
    pressing = torch.zeros(1, 4, 3)
    pressing[..., 1] = -0.5
    trajectory = simulator.rollout(simulator.initial_state(), pressing)
    centre = trajectory.tool_poses[0, -1, 0, :3]
    distance = (trajectory.positions[0, -1] - centre).norm(dim=-1)
    below = trajectory.positions[0, 0, :, 1].max()
    assert centre[1] - 0.03 < below - 0.02  # it went 2 cm deep
    assert distance.min() > 0.03 - 0.006  # and no particle is deeper inside than the contact layer


@pytest.mark.parametrize("memory_budget", [0, 1 << 29])
def test_rollout_of_both_halves_is_the_whole(backend: Backend, memory_budget: int) -> None:
    simulator = backend(CASES["two tools"], threads=1, memory_budget=memory_budget)
    state, actions = stirred(simulator), actions_for(simulator, steps=4)
    whole = simulator.rollout(state, actions)
    first = simulator.rollout(state, actions[:, :2])
    second = simulator.rollout(first.final_state, actions[:, 2:])
    assert torch.equal(second.final_state.position, whole.final_state.position)
    assert torch.equal(second.final_state.elastic_strain, whole.final_state.elastic_strain)
    assert torch.equal(second.tool_poses, whole.tool_poses[:, 2:])


def test_recomputed_and_kept_substeps_give_the_same_gradient(backend: Backend) -> None:
    gradients, estimates = [], []
    for budget in (0, 1 << 29):
        simulator = backend(CASES["two tools"], threads=1, memory_budget=budget)
        trajectory = simulator.rollout(stirred(simulator), actions_for(simulator, steps=3))
        gradients.append(simulator.vjp(trajectory, torch.ones_like(trajectory.positions)).actions)
        estimates.append(simulator.memory_estimate(3))
    assert torch.equal(*gradients)
    # Three steps' records are kept against one's.
    assert 0 < 1.3 * estimates[0] < estimates[1]


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_a_batch_is_a_loop_over_worlds(backend: Backend, threads: int) -> None:
    simulator: Simulator = backend(CASES["two tools"], batch_size=3, threads=threads, dtype=torch.float64)
    state, actions = stirred(simulator, batch_size=3), actions_for(simulator, batch_size=3)
    together = simulator.rollout(state, actions)
    grad = torch.ones_like(together.positions)
    gradient = simulator.vjp(together, grad).actions
    for world in range(3):
        alone = simulator.rollout(state.select(world), actions[world : world + 1])
        assert torch.allclose(alone.positions[0], together.positions[world], atol=1e-12)
        assert torch.allclose(simulator.vjp(alone, grad[:1]).actions[0], gradient[world], rtol=1e-7, atol=1e-12)


def test_repeated_rollouts_are_equal_bit_for_bit(backend: Backend) -> None:
    simulator = backend(CASES["two tools"])
    state, actions = stirred(simulator), actions_for(simulator)
    assert torch.equal(simulator.rollout(state, actions).positions, simulator.rollout(state, actions).positions)


def test_tools_move_as_told(backend: Backend) -> None:
    simulator = backend(
        scene(
            tool(
                "Sphere",
                position=(0.3, 0.5, 0.5),
                rotation_wxyz=(1.0, 0.0, 0.0, 0.0),
                action_scale=(0.02, 0.02, 0.02, 0.0, 0.0, 0.5),
            ),
            tool("Sphere", position=(0.7, 0.5, 0.5), upper_bound=(0.71, 1.0, 1.0)),
        ),
        dtype=torch.float64,
    )
    actions = torch.tensor([[1.0, -0.5, 0.0, 0.0, 0.0, 1.0, 1.0, 0.0, 0.0]]).expand(3, -1).unsqueeze(0)
    first, second = simulator.rollout(simulator.initial_state(), actions).tool_poses[0, -1]
    assert torch.allclose(first[:3], torch.tensor([0.36, 0.47, 0.5], dtype=torch.float64), atol=1e-12)
    half = 0.5 * 3 * 0.5
    assert torch.allclose(first[3:7], torch.tensor([math.cos(half), 0.0, 0.0, math.sin(half)], dtype=torch.float64), atol=1e-12)
    assert torch.allclose(second[:3], torch.tensor([0.71, 0.5, 0.5], dtype=torch.float64), atol=1e-12)


def test_autograd_reaches_a_policy_through_the_rollout(backend: Backend) -> None:
    simulator = backend(CASES["capsule, sticky floor"], dtype=torch.float64)
    state = simulator.initial_state()
    gain = torch.tensor(0.5, dtype=torch.float64, requires_grad=True)
    pattern = actions_for(simulator)
    trajectory = differentiable_rollout(simulator, state, gain * pattern)
    trajectory.positions[:, -1].square().sum().backward()
    assert gain.grad is not None
    upstream = torch.zeros_like(trajectory.positions)
    upstream[:, -1] = 2 * trajectory.positions[:, -1].detach()
    expected = (simulator.vjp(simulator.rollout(state, 0.5 * pattern), upstream).actions * pattern).sum()
    assert float(gain.grad) == pytest.approx(float(expected), rel=1e-9)


def test_a_broken_world_does_not_touch_the_others(backend: Backend) -> None:
    simulator = backend(CASES["sphere"], batch_size=2, threads=1)
    state, actions = stirred(simulator, batch_size=2), actions_for(simulator, batch_size=2)
    state.affine[0, 0] = 1e30  # finite, and the strain of the first substep is not
    trajectory = simulator.rollout(state, actions)
    alone = simulator.rollout(state.select(1), actions[1:])
    assert torch.isnan(trajectory.positions[0, -1]).any()
    assert torch.equal(trajectory.positions[1], alone.positions[0])


def test_bad_arguments_are_named(backend: Backend) -> None:
    simulator = backend(CASES["sphere"])
    state = simulator.initial_state()
    with pytest.raises(InputError, match="actions"):
        simulator.rollout(state, torch.zeros(1, 2, 4))
    with pytest.raises(InputError, match="at least one step"):
        simulator.rollout(state, torch.zeros(1, 0, 3))
    with pytest.raises(InputError, match="batch_size"):
        simulator.rollout(state.fork(2), torch.zeros(2, 2, 3))
    with pytest.raises(InputError, match="threads"):
        backend(CASES["sphere"], threads=0)
    with pytest.raises(InputError, match="batch_size"):
        backend(CASES["sphere"], batch_size=0)
    with pytest.raises(CapabilityError, match="float16"):
        backend(CASES["sphere"], dtype=torch.float16)
    with pytest.raises(CapabilityError, match="mps"):
        backend(CASES["sphere"], device="mps")
    foreign = dataclasses.replace(simulator.rollout(state, torch.zeros(1, 1, 3)), checkpoints=None)
    with pytest.raises(InputError, match="checkpoints"):
        simulator.vjp(foreign, torch.zeros(1, 2, 300, 3))


@pytest.fixture(scope="module")
def worker() -> Iterator[ProcessPoolExecutor]:
    """A process of its own for CUDA: this one's Taichi runs on the CPU."""
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        yield pool


@pytest.mark.cuda
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("backend_name", BACKENDS)
def test_cuda_follows_the_cpu(backend_name: str, name: str, worker: ProcessPoolExecutor) -> None:
    positions, gradient = positions_and_gradient(backend_name, name, "cpu")
    other_positions, other_gradient = worker.submit(positions_and_gradient, backend_name, name, "cuda").result()
    assert torch.allclose(positions, other_positions, atol=1e-10)
    assert torch.allclose(gradient, other_gradient, rtol=1e-6, atol=1e-10)
