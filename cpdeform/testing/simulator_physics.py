"""Checks of a simulator's physics against conservation laws, closed forms and symmetries; see ``docs/physics.md``."""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from cpdeform.core.scene import Scene
from cpdeform.core.simulator import Simulator
from cpdeform.core.state import STRAIN_COMPONENTS, State
from cpdeform.testing.report import CheckItem, Finding, Skip, worst
from cpdeform.testing.simulator_bench import (
    SimulatorBench,
    example_tool,
    floating,
    largest_difference,
    no_actions,
    resting,
    stirred,
)


def left_cauchy_green(strain: Tensor) -> Tensor:
    """Matrices b (..., 3, 3) of `State.elastic_strain` (..., 6), in double precision."""
    strain = strain.double()
    matrix = torch.eye(3, dtype=torch.float64, device=strain.device).expand(*strain.shape[:-1], 3, 3).clone()
    for index, (row, column) in enumerate(STRAIN_COMPONENTS):
        matrix[..., row, column] += strain[..., index]
        if row != column:
            matrix[..., column, row] += strain[..., index]
    return matrix


def _float_freely(simulator: Simulator, state: State, steps: int = 3) -> State:
    return simulator.rollout(state, no_actions(simulator, steps=steps)).final_state


def check_uniform_motion(bench: SimulatorBench) -> Finding:
    """A body that moves as a whole keeps its velocity, which it would not if mass were lost, and travels v t."""
    simulator = bench.make(floating())
    state = simulator.initial_state()
    velocity = torch.tensor([0.7, -0.5, 0.3]).to(state.velocity)
    state = dataclasses.replace(state, velocity=velocity.expand_as(state.velocity).contiguous())
    final = _float_freely(simulator, state)
    seconds = 3 * simulator.scene.substeps * simulator.scene.time_step
    figures = {
        "velocity": largest_difference(final.velocity, state.velocity),
        "position": largest_difference(final.position, state.position + seconds * velocity),
        "strain": largest_difference(final.elastic_strain, state.elastic_strain),
    }
    return worst(figures, bench.bound(1e-7, 1e-4))


def check_momentum(bench: SimulatorBench) -> Finding:
    """The sum of all velocities stays, per particle."""
    simulator = bench.make(floating())
    state = stirred(simulator)
    final = _float_freely(simulator, state)
    change = (final.velocity.double().mean(dim=1) - state.velocity.double().mean(dim=1)).abs().max()
    return Finding(float(change), bench.bound(1e-8, 1e-5))


def check_angular_momentum(bench: SimulatorBench) -> Finding:
    """The moment of momentum stays, relative to its size."""
    simulator = bench.make(floating())
    state = stirred(simulator)

    def moment(at: State) -> Tensor:
        # APIC particles carry spin in the affine field C: the stencil's second moment is dx^2/4
        spin, c = 0.25 * simulator.scene.node_distance**2, at.affine.double()
        own = torch.stack([c[..., 2, 1] - c[..., 1, 2], c[..., 0, 2] - c[..., 2, 0], c[..., 1, 0] - c[..., 0, 1]], dim=-1)
        total: Tensor = (torch.linalg.cross(at.position.double(), at.velocity.double()) + spin * own).sum(dim=1)
        return total

    before, after = moment(state), moment(_float_freely(simulator, state))
    return Finding(float((after - before).abs().max() / before.abs().max()), bench.bound(1e-6, 1e-4))


def check_free_fall(bench: SimulatorBench) -> Finding:
    """Speed g t, and depth of the sum over the substeps, relative to both."""
    simulator = bench.make(floating(gravity_parameter=(0.0, -1.0, 0.0)))
    scene, state, steps = simulator.scene, simulator.initial_state(), 4
    final = _float_freely(simulator, state, steps)
    count = steps * scene.substeps
    speed = scene.gravity[1] * count * scene.time_step
    depth = scene.gravity[1] * scene.time_step**2 * count * (count + 1) / 2
    figures = {
        "velocity": float((final.velocity[..., 1].double() - speed).abs().max()) / abs(speed),
        "position": float((final.position[..., 1].double() - state.position[..., 1].double() - depth).abs().max()) / abs(depth),
    }
    return worst(figures, bench.bound(1e-7, 0.05))


def check_symmetry(bench: SimulatorBench) -> Finding:
    """Exchanging the axes x and z, or moving everything by whole nodes, does the same to the result."""
    simulator = bench.make(floating())
    state, swap, strain_swap = stirred(simulator), [2, 1, 0], [2, 1, 0, 5, 4, 3]
    swapped = State(
        state.position[..., swap],
        state.velocity[..., swap],
        state.affine[..., swap, :][..., swap],
        state.elastic_strain[..., strain_swap],
        state.tool_pose,
    )
    shift = torch.tensor([2.0, -3.0, 1.0]).to(state.position) * simulator.scene.node_distance
    moved = dataclasses.replace(state, position=state.position + shift)
    plain, other, there = (_float_freely(simulator, start, 2) for start in (state, swapped, moved))
    figures = {
        "position after exchanged axes": largest_difference(other.position[..., swap], plain.position),
        "strain after exchanged axes": 1e-2 * largest_difference(other.elastic_strain[..., strain_swap], plain.elastic_strain),
        "position after a shift": largest_difference(there.position - shift, plain.position),
    }
    return worst(figures, bench.bound(1e-11, 1e-5))


def _hencky_deviator(strain: Tensor) -> Tensor:
    """Length (...) of the deviator of the logarithmic strain."""
    hencky = 0.5 * torch.log(torch.linalg.eigvalsh(left_cauchy_green(strain)))
    length: Tensor = torch.linalg.vector_norm(hencky - hencky.mean(dim=-1, keepdim=True), dim=-1)
    return length


def check_yield_surface(bench: SimulatorBench) -> Finding:
    """No stress beyond the yield stress; and clay strained beyond it does reach it."""
    simulator = bench.make(floating())
    material = simulator.scene.material
    limit = material.yield_stress / (2.0 * material.shear_modulus)
    deviator = _hencky_deviator(_float_freely(simulator, stirred(simulator), 2).elastic_strain) / limit
    figures = {"beyond the surface": float(deviator.max()) - 1.0, "below it, though strained beyond": 0.99 - float(deviator.max())}
    return worst(figures, bench.bound(1e-6, 1e-3))


def check_elastic_below_yield(bench: SimulatorBench) -> Finding:
    """Below the yield stress the strain follows the motion: b becomes (I + dt C) b (I + dt C)^T in a substep."""
    simulator = bench.make(floating(substeps=1, material={"yield_stress": 1e6}))
    state = stirred(simulator)
    final = _float_freely(simulator, state, 1)
    motion = torch.eye(3, dtype=torch.float64, device=state.affine.device) + simulator.scene.time_step * state.affine.double()
    expected = motion @ left_cauchy_green(state.elastic_strain) @ motion.mT
    return Finding(largest_difference(left_cauchy_green(final.elastic_strain), expected), bench.bound(1e-9, 1e-5))


def check_flow_keeps_volume(bench: SimulatorBench) -> Finding:
    """Plastic flow changes no volume: det b grows by det(I + dt C)^2 in a substep, also where the clay yields."""
    simulator = bench.make(floating(substeps=1))
    state = stirred(simulator)
    final = _float_freely(simulator, state, 1)
    motion = torch.eye(3, dtype=torch.float64, device=state.affine.device) + simulator.scene.time_step * state.affine.double()
    expected = torch.linalg.det(motion).square() * torch.linalg.det(left_cauchy_green(state.elastic_strain))
    found = torch.linalg.det(left_cauchy_green(final.elastic_strain))
    return Finding(largest_difference(found, expected), bench.bound(1e-9, 1e-5))


def _squeezing_scene(kinds: tuple[str, ...]) -> Scene:
    for kind in ("Sphere", "Capsule", "Box", "Cylinder", "Torus"):
        if kind in kinds:
            tool = example_tool(kind, action_scale=(0.02, 0.02, 0.02))
            return resting(tool, grid_size=64, substeps=19, gravity_parameter=(0.0, 0.0, 0.0))
    raise Skip("It declares no kind of tool that could squeeze.")


def check_squeeze(bench: SimulatorBench) -> Finding:
    """A tool pressed into the clay pushes it down, and the clay's volume stays within a few percent."""
    simulator = bench.make(_squeezing_scene(bench.capabilities.tool_kinds))
    actions = no_actions(simulator, steps=4)
    actions[..., 1] = -0.5
    state = simulator.initial_state()
    final = simulator.rollout(state, actions).final_state
    volume = torch.linalg.det(left_cauchy_green(final.elastic_strain)).sqrt()
    pushed = float((state.position[..., 1] - final.position[..., 1]).double().max())
    figures = {
        "change of volume": abs(float(volume.mean()) - 1.0),
        "clay not pushed down (0.5: not at all)": 50.0 * (0.01 - pushed),
    }
    return worst(figures, 0.1)


PHYSICS_CHECKS: tuple[CheckItem[SimulatorBench], ...] = (
    CheckItem(
        "mass and uniform motion are kept", check_uniform_motion, "Weights of a particle's stencil must sum to 1 in both transfers."
    ),
    CheckItem(
        "momentum is kept without forces", check_momentum, "The stress term must sum to zero over the stencil; see the transfers."
    ),
    CheckItem(
        "angular momentum is kept without forces",
        check_angular_momentum,
        "The stress must be symmetric, and C be carried as in APIC.",
    ),
    CheckItem(
        "free fall has the closed form", check_free_fall, "Gravity is gravity_scale times gravity_parameter, added to the velocity."
    ),
    CheckItem(
        "physics does not depend on axis and place",
        check_symmetry,
        "An index of an axis, or of the strain's six numbers, is wrong.",
    ),
    CheckItem(
        "no stress beyond the yield surface", check_yield_surface, "Apply the return mapping to the logarithmic strain's deviator."
    ),
    CheckItem(
        "strain follows the motion below yield",
        check_elastic_below_yield,
        "b* = (I + dt C) b (I + dt C)^T with the C of the state.",
    ),
    CheckItem(
        "plastic flow keeps the volume", check_flow_keeps_volume, "The return mapping must leave the logarithmic strain's mean."
    ),
    CheckItem(
        "volume is nearly kept under a squeeze", check_squeeze, "Compare pressure (lambda J (J - 1)) and the tool's contact."
    ),
)
