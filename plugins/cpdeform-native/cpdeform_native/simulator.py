"""The native backend's `Simulator`: torch tensors on the outside, C++ inside."""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor

from cpdeform.backends.checkpointing import SimulatorCheckpointing
from cpdeform.backends.scene_numbers import material_numbers, scene_numbers, tool_numbers
from cpdeform.core.errors import CapabilityError, InputError, MissingExtraError
from cpdeform.core.scene import WALL_NODES, Scene
from cpdeform.core.simulator import RolloutGradient, SimulatorCapabilities, Trajectory
from cpdeform.core.state import State

try:
    from cpdeform_native import _simulator
except ImportError as error:
    raise MissingExtraError(
        "simulator", "native", module="cpdeform_native._simulator", install="pip install cpdeform-native"
    ) from error

TOOL_KINDS = ("Sphere", "Capsule", "Box", "Cylinder", "Torus", "RollingPin", "Chopsticks", "Mesh")
"""The kinds of tools that the C++ knows."""


class SimulatorNative(SimulatorCheckpointing):
    """MLS-MPM with von Mises plasticity in C++ for the CPU, with hand-written adjoints.

    Particles are a structure of arrays, sorted by cell at every environment step and computed a vector register at a time; the grid
    covers just the nodes they touch. Worlds are spread over the threads first; the worlds left over are computed one after the
    other, each with its particles spread over all threads (its sums then depend on the number of threads in the last digits).

    Args:
        scene: What to simulate.
        batch_size: The most worlds that one call may hold.
        device: ``"cpu"``.
        dtype: `torch.float32` (default) or `torch.float64`; the tools' motion is always computed in float64.
        threads: Threads; defaults to those the process may use.
        memory_budget: Bytes that a rollout may keep for its way back. Where all substeps fit, none is computed twice; otherwise
            one checkpoint per environment step is kept and the inside recomputed.
        instruction_set: ``"baseline"``, ``"avx2"`` or ``"avx512"``; defaults to the fastest that the processor has.

    Raises:
        CapabilityError: The device, type or a tool is not supported.
        InputError: An option is out of range, or the processor lacks the instruction set.
    """

    capabilities: ClassVar[SimulatorCapabilities] = SimulatorCapabilities(
        differentiable=True,
        devices=("cpu",),
        dtypes=(torch.float32, torch.float64),
        tool_kinds=TOOL_KINDS,
        deterministic_devices=("cpu",),
    )

    def __init__(
        self,
        scene: Scene,
        *,
        batch_size: int = 1,
        device: torch.device | str = "cpu",
        dtype: torch.dtype | None = None,
        threads: int | None = None,
        memory_budget: int = 1 << 29,
        instruction_set: str | None = None,
    ) -> None:
        super().__init__(scene, batch_size=batch_size, device=device, dtype=dtype, threads=threads, memory_budget=memory_budget)
        if len(scene.tools) > _simulator.MAX_TOOLS:
            raise CapabilityError(f"SimulatorNative has at most {_simulator.MAX_TOOLS} tools, not {len(scene.tools)}.")
        known = _simulator.instruction_sets()
        if instruction_set is not None and instruction_set not in known:
            raise InputError(
                "instruction_set", came=repr(instruction_set), expected=f"one that this processor has: {', '.join(known)}"
            )
        engine = _simulator.SimulatorFloat if self.dtype is torch.float32 else _simulator.SimulatorDouble
        material = np.ascontiguousarray(material_numbers(scene).T)
        self._engine = engine(_native_scene(scene), material, self.threads, instruction_set or "")

    @property
    def instruction_set(self) -> str:
        """The instruction set in use."""
        return str(self._engine.instruction_set)

    def rollout(self, state: State, actions: Tensor) -> Trajectory:
        """Simulate T environment steps; see `Simulator.rollout`."""
        return self._rollout(state, actions, memory_budget=self.memory_budget)

    def simulate(self, state: State, actions: Tensor) -> Trajectory:
        """Simulate T environment steps and keep nothing for `vjp`; see `Simulator.simulate`."""
        return dataclasses.replace(self._rollout(state, actions, memory_budget=0), checkpoints=None)

    def _rollout(self, state: State, actions: Tensor, *, memory_budget: int) -> Trajectory:
        self.check_inputs(state, actions)
        state, actions = state.map(self._own), self._own(actions)
        worlds, steps, tools = state.batch_size, actions.shape[1], state.tool_pose.shape[1]
        positions = torch.empty(worlds, steps + 1, state.particle_count, 3, dtype=self.dtype)
        poses = torch.empty(worlds, steps + 1, tools, 8, dtype=self.dtype)
        velocity, affine, strain = (torch.empty_like(value) for value in (state.velocity, state.affine, state.elastic_strain))
        checkpoints = self._engine.rollout(
            worlds,
            steps,
            *_arrays(
                state.position,
                state.velocity,
                state.affine,
                state.elastic_strain,
                state.tool_pose,
                actions,
                positions,
                poses,
                velocity,
                affine,
                strain,
            ),
            keep=worlds * steps * self._step_bytes() <= memory_budget,
        )
        final = State(positions[:, -1].clone(), velocity, affine, strain, poses[:, -1].clone())
        return Trajectory(
            positions=positions,
            tool_poses=poses,
            actions=actions.clone(),
            initial_state=state,
            final_state=final,
            checkpoints=(checkpoints, actions),
        )

    def vjp(
        self,
        trajectory: Trajectory,
        grad_positions: Tensor,
        grad_tools: Tensor | None = None,
        *,
        grad_final_state: State | None = None,
    ) -> RolloutGradient:
        """Pull gradients back through a rollout; see `Simulator.vjp`."""
        positions, poses, final = self._incoming(trajectory, grad_positions, grad_tools, grad_final_state)
        checkpoints, actions = trajectory.checkpoints
        if not self._engine.made(checkpoints):
            raise InputError("trajectory", came="one made by another simulator", expected="one made by this simulator's rollout")
        gradient = trajectory.initial_state.map(torch.empty_like)
        grad_actions = torch.zeros(actions.shape, dtype=torch.float64)
        grad_pose = torch.empty(gradient.tool_pose.shape, dtype=torch.float64)
        last = (None, None, None) if final is None else _arrays(final.velocity, final.affine, final.elastic_strain)
        self._engine.vjp(
            checkpoints,
            actions.numpy(),
            positions.contiguous().numpy(),
            None if poses is None else poses.contiguous().numpy(),
            *last,
            *_arrays(grad_actions, gradient.position, gradient.velocity, gradient.affine, gradient.elastic_strain, grad_pose),
        )
        start = dataclasses.replace(gradient, tool_pose=grad_pose.to(self.dtype))
        return RolloutGradient(actions=grad_actions.to(self.dtype), initial_state=start)

    def _step_bytes(self) -> int:
        """Bytes of the records of every substep of one environment step of a world."""
        return self.scene.substeps * (self.scene.particle_count * self._particle_bytes() + self._grid_bytes())

    def _keeps_substeps(self, step_count: int, worlds: int) -> bool:
        return worlds * step_count * self._step_bytes() <= self.memory_budget

    def memory_estimate(self, step_count: int, *, worlds: int | None = None) -> int:
        """Bytes that a rollout and its `vjp` hold at their peak; see `Simulator.memory_estimate`."""
        worlds = worlds or self.batch_size
        count, particles = self.scene.particle_count, self.scene.particle_count * self._particle_bytes()
        active = self.threads if worlds >= self.threads else 1
        history = worlds * step_count * (self._step_bytes() + 4 * count)
        if not self._keeps_substeps(step_count, worlds):
            history = worlds * step_count * (particles + 4 * count) + active * self._step_bytes()
        # frames in scene and step order and their gradients; grids of momentum, velocity and gradients
        work = active * (5 * particles + 5 * self._grid_bytes())
        snapshots = (step_count + 1) * count * 3 * self.dtype.itemsize
        # trajectory and the caller's gradient of it; initial and final state, and gradient of the initial one
        return history + work + worlds * (2 * snapshots + 3 * particles)

    def release_memory(self) -> None:
        """Give back to the system what is kept between rollouts to be used again; trajectories stay usable."""
        self._engine.release_memory()


def _arrays(*tensors: Tensor) -> list[Any]:
    return [tensor.numpy() for tensor in tensors]


def _native_scene(scene: Scene) -> Any:
    numbers = scene_numbers(scene)
    native = _simulator.Scene(
        time_step=numbers.time_step,
        node_distance=numbers.node_distance,
        particle_mass=numbers.particle_mass,
        gravity=numbers.gravity,
        softness=numbers.softness,
        ground_friction=numbers.ground_friction,
        ground_nodes=numbers.ground_nodes,
        wall_nodes=WALL_NODES,
        lower=numbers.lower,
        upper=numbers.upper,
        grid_size=numbers.grid_size,
        substeps=scene.substeps,
        particle_count=scene.particle_count,
    )
    for tool, shape in zip(tool_numbers(scene), scene.tools, strict=True):
        grid = shape.kernel_grid
        native.add_tool(
            kind=tool.kind,
            size=tool.size,
            friction=tool.friction,
            action_size=tool.action_size,
            scale=tool.scale,
            lower=tool.lower,
            upper=tool.upper,
            grid=None if grid is None else np.ascontiguousarray(grid, dtype=np.float64),
        )
    return native
