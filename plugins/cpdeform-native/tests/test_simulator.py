"""What is particular to the native simulator: instruction sets, threads, checkpoints, and what it refuses."""

from __future__ import annotations

import dataclasses
import gc
import multiprocessing
import os

import pytest
import torch
from torch import Tensor

from cpdeform.core.errors import CapabilityError, InputError
from cpdeform.core.scene import Scene
from cpdeform.core.simulator import Trajectory
from cpdeform.core.state import State
from cpdeform_native import _simulator
from cpdeform_native.simulator import SimulatorNative

INSTRUCTION_SETS = _simulator.instruction_sets()
REST = (1.0, 0.0, 0.0, 0.0)


def make_scene(*, particle_count: int = 500, tool_count: int = 1) -> Scene:
    body = {"kind": "box", "position": (0.5, 0.1, 0.5), "widths": (0.14, 0.12, 0.14), "particle_count": particle_count}
    scale = (0.02, 0.02, 0.02, 0.2, 0.2, 0.2)
    tool = {"kind": "Capsule", "radius": 0.03, "height": 0.05, "position": (0.5, 0.19, 0.5), "action_scale": scale}
    material = {"youngs_modulus": 5.0, "poisson_ratio": 0.3, "yield_stress": 0.1}
    return Scene.model_validate(
        {"bodies": [body], "tools": [tool] * tool_count, "material": material, "grid_size": 32, "substeps": 5}
    )


def stirred(simulator: SimulatorNative, *, worlds: int = 1) -> State:
    """A start with random velocities and strains on both sides of the yield surface."""
    generator = torch.Generator().manual_seed(0)
    state = simulator.initial_state(batch_size=worlds)

    def noise(tensor: Tensor, size: float) -> Tensor:
        return size * torch.randn(tensor.shape, generator=generator, dtype=torch.float64).to(tensor)

    return dataclasses.replace(
        state,
        velocity=noise(state.velocity, 0.3),
        affine=noise(state.affine, 10.0),
        elastic_strain=noise(state.elastic_strain, 0.02),
    )


def run(simulator: SimulatorNative, *, worlds: int = 1, steps: int = 3) -> tuple[Trajectory, Tensor]:
    """A rollout from a stirred start, and the gradient of the actions of a fixed linear functional."""
    generator = torch.Generator().manual_seed(1)
    shape = (worlds, steps, simulator.scene.action_size)
    actions = (0.5 * torch.randn(shape, generator=generator, dtype=torch.float64)).clamp(-1, 1)
    trajectory = simulator.rollout(stirred(simulator, worlds=worlds), actions.to(simulator.dtype))
    weights = torch.randn(trajectory.positions.shape, generator=generator, dtype=torch.float64).to(simulator.dtype)
    return trajectory, simulator.vjp(trajectory, weights).actions


def cosine(a: Tensor, b: Tensor) -> float:
    return float(torch.nn.functional.cosine_similarity(a.flatten().double(), b.flatten().double(), dim=0))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("instruction_set", INSTRUCTION_SETS)
def test_instruction_sets_compute_the_same(instruction_set: str, dtype: torch.dtype) -> None:
    # 13 particles beyond whole vectors of any width
    scene = make_scene(particle_count=509)
    expected, expected_gradient = run(SimulatorNative(scene, dtype=torch.float64, instruction_set="baseline", threads=1))
    simulator = SimulatorNative(scene, dtype=dtype, instruction_set=instruction_set, threads=1)
    assert simulator.instruction_set == instruction_set
    trajectory, gradient = run(simulator)
    tolerance = 1e-12 if dtype is torch.float64 else 2e-6
    assert torch.allclose(trajectory.positions.double(), expected.positions, rtol=0.0, atol=tolerance)
    assert cosine(gradient, expected_gradient) > 1.0 - (1e-12 if dtype is torch.float64 else 1e-6)
    assert float(gradient.norm()) == pytest.approx(float(expected_gradient.norm()), rel=1e-9 if dtype is torch.float64 else 1e-3)


@pytest.mark.parametrize("threads", [2, 3, 8])
@pytest.mark.parametrize("worlds", [1, 2, 5])
def test_threads_change_nothing_but_rounding(threads: int, worlds: int) -> None:
    scene = make_scene()
    expected, expected_gradient = run(SimulatorNative(scene, dtype=torch.float64, batch_size=worlds, threads=1), worlds=worlds)
    simulator = SimulatorNative(scene, dtype=torch.float64, batch_size=worlds, threads=threads)
    trajectory, gradient = run(simulator, worlds=worlds)
    assert torch.allclose(trajectory.positions, expected.positions, rtol=0.0, atol=1e-13)
    assert torch.allclose(gradient, expected_gradient, rtol=1e-8, atol=1e-10 * float(expected_gradient.abs().max()))
    again, gradient_again = run(simulator, worlds=worlds)
    assert torch.equal(trajectory.positions, again.positions)
    assert torch.equal(gradient, gradient_again)


@pytest.mark.parametrize("particle_count", [1, 2, 17])
def test_fewer_particles_than_threads_or_lanes(particle_count: int) -> None:
    scene = make_scene(particle_count=particle_count)
    expected, expected_gradient = run(SimulatorNative(scene, dtype=torch.float64, threads=1, instruction_set="baseline"))
    trajectory, gradient = run(SimulatorNative(scene, dtype=torch.float64, threads=8))
    assert torch.allclose(trajectory.positions, expected.positions, rtol=0.0, atol=1e-13)
    assert torch.allclose(gradient, expected_gradient, rtol=1e-7, atol=1e-10 * float(expected_gradient.abs().max()) + 1e-30)


@pytest.mark.parametrize("threads", [1, 2])
def test_recomputed_substeps_give_the_same_gradient(threads: int) -> None:
    scene = make_scene()
    kept, gradient = run(SimulatorNative(scene, threads=threads))
    recomputed, gradient_again = run(SimulatorNative(scene, threads=threads, memory_budget=0))
    assert torch.equal(kept.positions, recomputed.positions)
    assert torch.equal(gradient, gradient_again)
    assert recomputed.checkpoints[0].nbytes < kept.checkpoints[0].nbytes


def test_a_trajectory_outlives_its_simulator() -> None:
    simulator = SimulatorNative(make_scene(), threads=2)
    trajectory, _ = run(simulator)
    positions, size = trajectory.positions.clone(), trajectory.checkpoints[0].nbytes
    # At least the substeps' particles: position, velocity, affine field and strain, in single precision.
    assert size > simulator.scene.substeps * simulator.scene.particle_count * 21 * 4
    del simulator
    gc.collect()
    assert torch.equal(trajectory.positions, positions)
    assert trajectory.checkpoints[0].nbytes == size


def test_released_memory_is_taken_again_when_needed() -> None:
    simulator = SimulatorNative(make_scene(), threads=2)
    trajectory, gradient = run(simulator)
    simulator.release_memory()
    again, gradient_again = run(simulator)
    assert torch.equal(trajectory.positions, again.positions)
    assert torch.equal(gradient, gradient_again)


def test_a_trajectory_of_another_simulator_is_refused() -> None:
    trajectory, _ = run(SimulatorNative(make_scene(), threads=1))
    with pytest.raises(InputError, match="another simulator"):
        SimulatorNative(make_scene(), threads=1).vjp(trajectory, torch.zeros_like(trajectory.positions))


def test_a_position_that_is_not_finite_spreads_and_does_not_crash() -> None:
    simulator = SimulatorNative(make_scene(), threads=2)
    state = simulator.initial_state()
    state.affine[0, 3] = 1e30  # finite, but the strain of the first substep is not, and then neither are positions
    trajectory = simulator.rollout(state, torch.zeros(1, 2, simulator.scene.action_size))
    assert bool(trajectory.positions[0, -1].isnan().any())
    simulator.vjp(trajectory, torch.ones_like(trajectory.positions))


def _child_rollout(simulator: SimulatorNative, queue: multiprocessing.Queue[float]) -> None:
    queue.put(float(run(simulator)[0].positions.double().sum()))


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system does not fork")
@pytest.mark.filterwarnings("ignore:This process .* is multi-threaded:DeprecationWarning")
def test_a_forked_child_computes_with_threads_of_its_own() -> None:
    simulator = SimulatorNative(make_scene(), threads=2)
    expected = float(run(simulator)[0].positions.double().sum())
    context = multiprocessing.get_context("fork")
    queue = context.Queue()
    child = context.Process(target=_child_rollout, args=(simulator, queue))
    child.start()
    came = queue.get(timeout=60)
    child.join(timeout=60)
    assert came == expected
    assert child.exitcode == 0


def test_unknown_instruction_set_is_named() -> None:
    with pytest.raises(InputError, match=r"instruction_set.*'sse9'.*baseline"):
        SimulatorNative(make_scene(), instruction_set="sse9")


def test_too_many_tools_are_refused() -> None:
    with pytest.raises(CapabilityError, match="at most 16"):
        SimulatorNative(make_scene(tool_count=17))


def test_threads_must_be_positive() -> None:
    with pytest.raises(InputError, match="threads"):
        SimulatorNative(make_scene(), threads=0)
