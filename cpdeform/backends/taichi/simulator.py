"""The Taichi backend's `Simulator`: tensors in, tensors out, records of particles between."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Iterator
from types import SimpleNamespace
from typing import ClassVar

import torch
from torch import Tensor

from cpdeform.backends.checkpointing import SimulatorCheckpointing
from cpdeform.backends.taichi.kernels_distance import TOOL_KINDS
from cpdeform.backends.taichi.kernels_motion import build_motion
from cpdeform.backends.taichi.kernels_substep import build_substep
from cpdeform.backends.taichi.kernels_types import AFFINE, POSITION, RECORD_SIZE, STRAIN, VELOCITY
from cpdeform.backends.taichi.runtime import require, ti
from cpdeform.backends.taichi.scene_arrays import make_materials, make_tools, make_values
from cpdeform.backends.taichi.stepper import Program, Stepper, Substep
from cpdeform.core.scene import Scene
from cpdeform.core.simulator import RolloutGradient, SimulatorCapabilities, Trajectory
from cpdeform.core.state import State


@dataclasses.dataclass(frozen=True)
class _Checkpoints:
    """What is kept of a rollout.

    Attributes:
        actions: Actions (W, T, A).
        poses: Tool poses (W, T * substeps + 1, max(M, 1), 8) in every frame.
        starts: Particles (W N, 21) at the start of each step.
        substeps: Per step, its substeps' records; None where they are to be computed anew.
    """

    actions: Tensor
    poses: Tensor
    starts: tuple[Tensor, ...]
    substeps: tuple[tuple[Substep, ...] | None, ...]


class SimulatorTaichi(SimulatorCheckpointing):
    """MLS-MPM with von Mises plasticity on Taichi, with hand-written adjoints.

    A process has one Taichi runtime, of one kind of device and with one pool of threads; the first simulator starts it, unless the
    program already has, and later ones share it. What it cannot serve, and a simulator in a forked child of a process that runs
    Taichi, is refused; a worker process that is spawned starts a runtime of its own::

        def final_positions(scene, actions, device):
            simulator = SimulatorTaichi(scene, device=device)
            return simulator.rollout(simulator.initial_state(), actions).positions[:, -1].cpu()

        with ProcessPoolExecutor(mp_context=multiprocessing.get_context("spawn")) as workers:
            positions = workers.submit(final_positions, scene, actions, "cuda").result()

    Args:
        scene: What to simulate.
        batch_size: The most worlds that one call may hold.
        device: ``"cpu"`` or ``"cuda"``, which is the first visible GPU.
        dtype: `torch.float32` (default) or `torch.float64`.
        threads: Threads on the CPU; defaults to those the process may use. Worlds are spread over them first, then the particles
            of one world (whose sums then depend on the number of threads in the last digits).
        memory_budget: Bytes that a rollout may keep for its way back. Where all substeps fit, none is computed twice; otherwise
            one checkpoint per environment step is kept and the inside recomputed.

    Raises:
        CapabilityError: The device, type or a tool is not supported.
        InputError: An option is out of range.
        TaichiRuntimeError: This process runs a Taichi that does not serve.
    """

    capabilities: ClassVar[SimulatorCapabilities] = SimulatorCapabilities(
        differentiable=True,
        devices=("cpu", "cuda"),
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
    ) -> None:
        super().__init__(scene, batch_size=batch_size, device=device, dtype=dtype, threads=threads, memory_budget=memory_budget)
        self.threads = require(self.device, threads)
        real = ti.f64 if self.dtype is torch.float64 else ti.f32
        on_cuda = self.device.type == "cuda"
        kernels = SimpleNamespace(**vars(build_substep(real, on_cuda)), **vars(build_motion(real)))
        values, tools, materials = (
            made.to(device=self.device, dtype=self.dtype) for made in (make_values(scene), make_tools(scene), make_materials(scene))
        )
        self._program = Program(scene, kernels, values, tools, materials, on_cuda)

    @contextlib.contextmanager
    def _stream(self) -> Iterator[None]:
        """Make sure of the runtime, and order Taichi's work, which is on CUDA's default stream, with torch's."""
        require(self.device, self.threads)
        if self.device.type == "cpu":
            yield
            return
        own, callers = torch.cuda.default_stream(self.device), torch.cuda.current_stream(self.device)
        own.wait_stream(callers)
        with torch.cuda.stream(own):
            yield
        callers.wait_stream(own)

    def _move_tools(self, state: State, actions: Tensor) -> Tensor:
        """Tool poses (B, T * substeps + 1, max(M, 1), 8) in every frame."""
        worlds, steps, tools = state.batch_size, actions.shape[1], state.tool_pose.shape[1]
        frames = steps * self.scene.substeps + 1
        poses = torch.zeros(worlds, frames, max(tools, 1), 8, dtype=self.dtype, device=self.device)
        if tools:
            poses[:, 0] = state.tool_pose
            self._program.kernels.move_tools(actions, self._program.tools, self.scene.substeps, tools, poses)
        return poses

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
        positions = torch.empty(worlds, steps + 1, state.particle_count, 3, dtype=self.dtype, device=self.device)
        positions[:, 0] = state.position
        keep = worlds * self._history_bytes(steps) <= memory_budget
        with self._stream():
            stepper = Stepper(self._program, worlds=worlds, threads=self.threads)
            poses, particles = self._move_tools(state, actions), _records(state)
            starts, kept = [], []
            for step in range(steps):
                starts.append(particles)
                records, particles = self._run_step(stepper, particles, poses, step, keep=keep)
                kept.append(records)
                positions[:, step + 1] = particles[:, :VELOCITY].view(worlds, -1, 3)
            frames = poses[:, :: self.scene.substeps, :tools].clone()
            final = _state(particles, frames[:, -1].clone())
        return Trajectory(
            positions=positions,
            tool_poses=frames,
            actions=actions.clone(),
            initial_state=state,
            final_state=final,
            checkpoints=(_Checkpoints(actions, poses, tuple(starts), tuple(kept)),),
        )

    def _run_step(
        self, stepper: Stepper, particles: Tensor, poses: Tensor, step: int, *, keep: bool
    ) -> tuple[tuple[Substep, ...] | None, Tensor]:
        records = []
        for frame in range(step * self.scene.substeps, (step + 1) * self.scene.substeps):
            record = stepper.forward(particles, poses, frame)
            particles = record.after
            if keep:
                records.append(record)
        return (tuple(records) if keep else None), particles

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
        (kept,) = trajectory.checkpoints
        state, actions = trajectory.initial_state, kept.actions
        with self._stream():
            gradient, grad_poses = self._pull_back_particles(kept, positions, final)
            if poses is not None:
                tools = state.tool_pose.shape[1]
                grad_poses[:, :: self.scene.substeps, :tools] += poses
            grad_start, grad_actions = torch.zeros_like(state.tool_pose), torch.zeros_like(actions)
            if tools := state.tool_pose.shape[1]:
                inputs = (actions, self._program.tools, self.scene.substeps, tools, kept.poses)
                self._program.kernels.move_tools_adjoint(*inputs, grad_poses, grad_actions, grad_start)
            start = _state(gradient, grad_start)
        # the kernels hold the strain's gradient as a symmetric matrix; the state's off-diagonal numbers stand for two entries
        start.elastic_strain[..., 3:] *= 2.0
        return RolloutGradient(actions=grad_actions, initial_state=start)

    def _pull_back_particles(self, kept: _Checkpoints, grad_positions: Tensor, final: State | None) -> tuple[Tensor, Tensor]:
        """Gradients with respect to the particles (W N, 21) at the start and the poses (W, frames, M, 8)."""
        worlds, frames, tools = kept.poses.shape[:3]
        stepper = Stepper(self._program, worlds=worlds, threads=self.threads)
        gradient = torch.zeros_like(kept.starts[0]) if final is None else _records(final)
        grad_poses = torch.zeros(stepper.rows * worlds, frames, tools, 8, dtype=self.dtype, device=self.device)
        position = gradient.view(worlds, -1, RECORD_SIZE)[..., :VELOCITY]
        steps = len(kept.starts)
        position.copy_(grad_positions[:, steps])
        for step in reversed(range(steps)):
            records = kept.substeps[step]
            if records is None:
                records, _ = self._run_step(stepper, kept.starts[step], kept.poses, step, keep=True)
            assert records is not None
            for index in reversed(range(self.scene.substeps)):
                stepper.backward(records[index], kept.poses, step * self.scene.substeps + index, gradient, grad_poses)
            # gone before the next step's are computed anew
            del records
            position += grad_positions[:, step]
        return gradient, grad_poses.view(stepper.rows, worlds, frames, tools, 8).sum(dim=0)

    def _history_bytes(self, step_count: int) -> int:
        """Bytes per world to keep every substep of a rollout."""
        return step_count * self.scene.substeps * (self.scene.particle_count * self._particle_bytes() + self._grid_bytes())

    def memory_estimate(self, step_count: int, *, worlds: int | None = None) -> int:
        """Bytes that a rollout and its `vjp` hold at their peak; see `Simulator.memory_estimate`."""
        worlds = worlds or self.batch_size
        count = self.scene.particle_count
        particles = count * self._particle_bytes()
        snapshots = (step_count + 1) * count * 3 * self.dtype.itemsize
        # the rows that particles add to, and the velocities
        rows = self.threads if self.device.type == "cpu" and worlds < self.threads else 1
        work = (rows + 1) * self._grid_bytes()
        history = self._history_bytes(step_count)
        if worlds * history > self.memory_budget:
            # records of a step, and half as much again that the allocator does not find a use for between two steps (measured)
            history = step_count * particles + self._history_bytes(1) * 3 // 2
        # snapshots and the caller's gradient of them; initial and final state, a gradient, and what a substep makes
        return worlds * (history + work + 2 * snapshots + 4 * particles)


def _records(state: State) -> Tensor:
    """Particles (W N, 21) as the kernels read them."""
    parts = (state.position, state.velocity, state.affine.flatten(2), state.elastic_strain)
    return torch.cat(parts, dim=-1).flatten(0, 1)


def _state(records: Tensor, poses: Tensor) -> State:
    """State, or gradient with respect to one, of particles (W N, 21) and tool poses (W, M, 8)."""
    worlds = poses.shape[0]
    parts = records.view(worlds, -1, RECORD_SIZE)
    affine = parts[..., AFFINE:STRAIN].view(worlds, -1, 3, 3)
    # cloned: slices of a single particle count as contiguous already, and would stay parts of the records
    position, velocity, affine, strain = (
        part.clone(memory_format=torch.contiguous_format)
        for part in (parts[..., POSITION:VELOCITY], parts[..., VELOCITY:AFFINE], affine, parts[..., STRAIN:])
    )
    return State(position, velocity, affine, strain, poses)
