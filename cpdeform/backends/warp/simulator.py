"""The Warp backend's `Simulator`: tensors in, tensors out, lanes of worlds between."""

from __future__ import annotations

import contextlib
import dataclasses
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar, TypeVar

import torch
import warp as wp
from torch import Tensor

from cpdeform.backends.checkpointing import SimulatorCheckpointing
from cpdeform.backends.kernel_cache import cache_folder, user_cache
from cpdeform.backends.warp.graph import Capture, Graphs, Lease, RolloutSlot, SlotKey, SlotPool, capture_on_cuda
from cpdeform.backends.warp.kernels_distance import TOOL_KINDS
from cpdeform.backends.warp.kernels_grid import build_grid
from cpdeform.backends.warp.kernels_motion import build_motion
from cpdeform.backends.warp.kernels_transfer import build_transfer
from cpdeform.backends.warp.kernels_types import build_types
from cpdeform.backends.warp.lane import Lane, Particles, Program, Substep
from cpdeform.backends.warp.scene_arrays import make_constants, make_parameters, make_tools
from cpdeform.core.forking import LocalThreads
from cpdeform.core.scene import Scene
from cpdeform.core.simulator import RolloutGradient, SimulatorCapabilities, Trajectory
from cpdeform.core.state import State

Result = TypeVar("Result")


@dataclasses.dataclass(frozen=True)
class _LaneCheckpoints:
    """What one lane keeps of a rollout.

    Attributes:
        worlds: First world of the lane and the one after its last.
        poses: Warp view (W, T * substeps + 1, M) of the tool poses.
        starts: Particles at the start of each step.
        substeps: Per step, its substeps' records; None where they are to be computed anew.
    """

    worlds: slice
    poses: Any
    starts: tuple[Particles, ...]
    substeps: tuple[tuple[Substep, ...] | None, ...]
    final: Particles


@dataclasses.dataclass(frozen=True)
class _Checkpoints:
    """What is kept of a rollout that was launched kernel by kernel.

    Attributes:
        actions: Actions (B, T, A).
        poses: Tool poses (B, T * substeps + 1, max(M, 1), 8) in every frame.
        lanes: What each lane keeps.
    """

    actions: Tensor
    poses: Tensor
    lanes: tuple[_LaneCheckpoints, ...]


class SimulatorWarp(SimulatorCheckpointing):
    """MLS-MPM with von Mises plasticity on NVIDIA Warp, with hand-written adjoints.

    Args:
        scene: What to simulate.
        batch_size: The most worlds that one call may hold.
        device: ``"cpu"``, ``"cuda"`` or ``"cuda:N"``.
        dtype: `torch.float32` (default) or `torch.float64`.
        threads: Threads on the CPU; defaults to those the process may use. Worlds are spread over them first, then the particles
            of one world (whose sums then depend on the number of threads in the last digits).
        memory_budget: Bytes that a rollout may keep for its way back. Where all substeps fit, none is computed twice; otherwise
            one checkpoint per environment step is kept and the inside recomputed.
        graphs: Whether rollouts on CUDA are captured as CUDA graphs, from the second of a shape (worlds, steps) on, and replayed;
            otherwise their kernels are launched one by one. Without effect on the CPU.

    Raises:
        CapabilityError: The device, type or a tool is not supported.
        InputError: An option is out of range.
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
        graphs: bool = True,
    ) -> None:
        super().__init__(scene, batch_size=batch_size, device=device, dtype=dtype, threads=threads, memory_budget=memory_budget)
        _initialize_warp()
        self._real = wp.float64 if self.dtype is torch.float64 else wp.float32
        self._types = build_types(self._real)
        self._program = self._make_program()
        self._pool = LocalThreads(self.threads) if self.device.type == "cpu" and self.threads > 1 else None
        self._done: torch.cuda.Event | None = None
        captured = graphs and self.device.type == "cuda"
        self._slots = self._make_slots(capture_on_cuda(self.device)) if captured else None

    def _make_program(self) -> Program:
        device = "cpu" if self.device.type == "cpu" else f"cuda:{self.device.index or 0}"
        kernels = SimpleNamespace(
            **vars(build_transfer(self._real)), **vars(build_grid(self._real)), **vars(build_motion(self._real))
        )
        # compile now, in this thread: a launch that finds its kernel not yet compiled is not safe from several threads
        for kernel in vars(kernels).values():
            kernel.module.load(wp.get_device(device), block_dim=1 if device == "cpu" else 256)
        return Program(
            types=self._types,
            kernels=kernels,
            parameters=make_parameters(self.scene, self._real, device),
            tools=make_tools(self.scene, self._real, device),
            constants=make_constants(self.scene, self._real, device),
            substeps=self.scene.substeps,
            device=device,
        )

    def _make_slots(self, capture: Capture | None) -> SlotPool[RolloutSlot]:
        # nothing here refers to the simulator, which would else live until a garbage collection, and so would its slots
        program, graphs, start = self._program, Graphs(capture), self.initial_state(batch_size=1)
        action_size = self.scene.action_size
        return SlotPool(lambda key: RolloutSlot(program, key, start=start, action_size=action_size, graphs=graphs))

    def release_memory(self) -> None:
        """Drop the arrays and graphs of rollouts whose trajectories are gone; see `Simulator.release_memory`."""
        if self._slots is None:
            return
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)  # streams other than the one that made the arrays may still read them
        self._slots.clear()
        if self.device.type == "cuda":
            torch.cuda.empty_cache()

    @contextlib.contextmanager
    def _stream(self) -> Iterator[None]:
        """Order Warp's work with torch's on CUDA."""
        if self.device.type == "cpu":
            yield
            return
        with torch.cuda.device(self.device):
            current = torch.cuda.current_stream()
            # a slot that came back may still be in use on the stream that the caller had chosen before
            if self._done is not None:
                current.wait_event(self._done)
            with wp.ScopedStream(wp.stream_from_torch(current)):
                yield
            self._done = current.record_event()

    def _lanes(self, worlds: int) -> list[tuple[Lane, slice]]:
        count = self.scene.particle_count
        if self.device.type != "cpu":
            return [(Lane(self._program, worlds=worlds, particle_count=count), slice(0, worlds))]
        pool, blocks = (self._pool, self.threads) if worlds < self.threads else (None, 1)
        return [
            (Lane(self._program, worlds=1, particle_count=count, pool=pool, blocks=blocks), slice(world, world + 1))
            for world in range(worlds)
        ]

    def _over_lanes(self, lanes: list[Any], work: Callable[[Any], Result]) -> list[Result]:
        """Do the work of all lanes, in parallel where each is one thread's."""
        if self._pool is None or len(lanes) < self.threads:
            return [work(lane) for lane in lanes]
        return list(self._pool.map(work, lanes))

    def _wrap(self, tensor: Tensor, dtype: Any) -> Any:
        return wp.from_torch(tensor.detach(), dtype=dtype, requires_grad=False)

    def _move_tools(self, state: State, actions: Tensor) -> Tensor:
        """Tool poses (B, T * substeps + 1, max(M, 1), 8) in every frame."""
        worlds, steps, tools = state.batch_size, actions.shape[1], state.tool_pose.shape[1]
        frames = steps * self.scene.substeps + 1
        poses = torch.zeros(worlds, frames, max(tools, 1), 8, dtype=self.dtype, device=self.device)
        if tools:
            poses[:, 0] = state.tool_pose
            inputs = [
                self._wrap(actions, self._real),
                self._program.tools,
                self.scene.substeps,
                self._wrap(poses, self._types.vec8),
            ]
            wp.launch(self._program.kernels.move_tools, dim=(worlds, tools), inputs=inputs, device=self._program.device)
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
        worlds, steps = state.batch_size, actions.shape[1]
        keep = worlds * self._history_bytes(steps, worlds) <= memory_budget
        if self._slots is None:
            return self._rollout_lanes(state, actions, keep)
        slots = self._slots

        def work() -> tuple[Lease[RolloutSlot], tuple[Tensor, Tensor, State]]:
            lease = slots.take(SlotKey(worlds, steps, keep))
            return lease, lease.slot.rollout(state, actions)

        with self._stream():
            lease, (positions, poses, final) = slots.with_memory(work)
        return Trajectory(
            positions=positions,
            tool_poses=poses,
            actions=actions,
            initial_state=state,
            final_state=final,
            checkpoints=(lease,),
        )

    def _rollout_lanes(self, state: State, actions: Tensor, keep: bool) -> Trajectory:
        """Launch a rollout kernel by kernel."""
        worlds, steps, tools = state.batch_size, actions.shape[1], state.tool_pose.shape[1]
        shape = (worlds, steps + 1, state.particle_count, 3)
        positions = torch.empty(shape, dtype=self.dtype, device=self.device)
        final = state.map(torch.empty_like)
        with self._stream():
            poses = self._move_tools(state, actions)
            lanes = self._over_lanes(
                self._lanes(worlds), lambda pair: self._rollout_lane(pair[0], pair[1], state, poses, positions, final, steps, keep)
            )
        frames = poses[:, :: self.scene.substeps, :tools]
        final = dataclasses.replace(final, tool_pose=frames[:, -1].clone())
        return Trajectory(
            positions=positions,
            tool_poses=frames.clone(),
            # the checkpoints hold those that were rolled out
            actions=actions.clone(),
            initial_state=state.clone(),
            final_state=final,
            checkpoints=(_Checkpoints(actions, poses, tuple(lanes)),),
        )

    def _particles(self, state: State, worlds: slice) -> Particles:
        types = self._types
        return Particles(
            self._wrap(state.position[worlds], types.vec3),
            self._wrap(state.velocity[worlds], types.vec3),
            self._wrap(state.affine[worlds], types.mat33),
            self._wrap(state.elastic_strain[worlds], types.vec6),
        )

    def _rollout_lane(
        self, lane: Lane, worlds: slice, state: State, poses: Tensor, positions: Tensor, final: State, steps: int, keep: bool
    ) -> _LaneCheckpoints:
        particles = self._particles(state, worlds)
        view = self._wrap(poses[worlds], self._types.vec8)
        positions[worlds, 0] = state.position[worlds]
        starts, kept = [], []
        for step in range(steps):
            starts.append(particles)
            records, particles = self._run_step(lane, particles, view, step, keep=keep)
            kept.append(records)
            positions[worlds, step + 1] = wp.to_torch(particles.position)
        targets = (final.position, final.velocity, final.affine, final.elastic_strain)
        for target, source in zip(targets, particles.arrays, strict=True):
            target[worlds] = wp.to_torch(source).reshape(target[worlds].shape)
        return _LaneCheckpoints(worlds, view, tuple(starts), tuple(kept), particles)

    def _run_step(
        self, lane: Lane, particles: Particles, poses: Any, step: int, *, keep: bool
    ) -> tuple[tuple[Substep, ...] | None, Particles]:
        records = []
        for frame in range(step * self.scene.substeps, (step + 1) * self.scene.substeps):
            record, particles = lane.forward(particles, poses, frame)
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
        lease = trajectory.checkpoints[0]
        if self._slots is None or not isinstance(lease, Lease):
            return self._vjp_lanes(trajectory, positions, poses, final)
        slot: RolloutSlot = lease.slot
        with self._stream():
            return self._slots.with_memory(lambda: slot.vjp(positions, poses, final))

    def _vjp_lanes(
        self, trajectory: Trajectory, grad_positions: Tensor, grad_tools: Tensor | None, final: State | None
    ) -> RolloutGradient:
        """Launch a vjp kernel by kernel."""
        (kept,) = trajectory.checkpoints
        state = trajectory.initial_state
        gradient = state.map(torch.zeros_like)
        if final is not None:
            last = {name: getattr(final, name) for name in ("velocity", "affine", "elastic_strain")}
            gradient = dataclasses.replace(gradient, **last)
        lanes = self._lanes(state.batch_size)
        with self._stream():
            parts = self._over_lanes(
                list(zip(lanes, kept.lanes, strict=True)),
                lambda pair: self._vjp_lane(pair[0][0], pair[1], grad_positions, gradient),
            )
            grad_poses = torch.cat(parts)
            if grad_tools is not None:
                tools = state.tool_pose.shape[1]
                grad_poses[:, :: self.scene.substeps, :tools] += grad_tools.to(grad_poses)
            grad_actions = self._pull_back_tools(kept, grad_poses, gradient)
        # the kernels hold the strain's gradient as a symmetric matrix; the state's off-diagonal numbers stand for two entries
        gradient.elastic_strain[..., 3:] *= 2.0
        return RolloutGradient(actions=grad_actions, initial_state=gradient)

    def _vjp_lane(self, lane: Lane, kept: _LaneCheckpoints, grad_positions: Tensor, gradient: State) -> Tensor:
        """Adjoint of one lane; writes its worlds of `gradient` and returns the gradient (W, frames, M, 8) of the poses."""
        worlds, frames, tools = kept.poses.shape
        rows = lane.blocks * worlds
        grad_poses = torch.zeros(rows, frames, tools, 8, dtype=self.dtype, device=self.device)
        view = self._wrap(grad_poses, self._types.vec8)
        particles = self._particles(gradient, kept.worlds)
        position = gradient.position[kept.worlds]
        steps = len(kept.starts)
        position += grad_positions[kept.worlds, steps]
        after = kept.final.velocity
        for step in reversed(range(steps)):
            after = self._vjp_step(lane, kept, step, after, particles, view)
            position += grad_positions[kept.worlds, step]
        return grad_poses.reshape(lane.blocks, worlds, frames, tools, 8).sum(dim=0)

    def _vjp_step(self, lane: Lane, kept: _LaneCheckpoints, step: int, after: Any, gradient: Particles, grad_poses: Any) -> Any:
        """Adjoint of one step, in place; returns the velocities before it. Records that it computes anew end with it."""
        records = kept.substeps[step]
        if records is None:
            records, _ = self._run_step(lane, kept.starts[step], kept.poses, step, keep=True)
        assert records is not None
        for index in reversed(range(self.scene.substeps)):
            lane.backward(records[index], after, kept.poses, step * self.scene.substeps + index, gradient, grad_poses)
            after = records[index].particles.velocity
        return after

    def _pull_back_tools(self, kept: _Checkpoints, grad_poses: Tensor, gradient: State) -> Tensor:
        """Gradient (B, T, A) of the actions; writes that of the start poses to `gradient`."""
        grad_actions = torch.zeros_like(kept.actions)
        worlds, tools = gradient.tool_pose.shape[:2]
        if not tools:
            return grad_actions
        types = self._types
        inputs = [
            self._wrap(kept.actions, self._real),
            self._program.tools,
            self.scene.substeps,
            self._wrap(kept.poses, types.vec8),
            self._wrap(grad_poses, types.vec8),
            self._wrap(grad_actions, self._real),
            self._wrap(gradient.tool_pose, types.vec8),
        ]
        wp.launch(self._program.kernels.move_tools_adjoint, dim=(worlds, tools), inputs=inputs, device=self._program.device)
        return grad_actions

    def _rows(self, worlds: int) -> int:
        """Grid rows of a world: one for each thread that works on it."""
        return self.threads if self.device.type == "cpu" and worlds < self.threads else 1

    def _history_bytes(self, step_count: int, worlds: int) -> int:
        """Bytes per world to keep every substep of a rollout."""
        substep = self.scene.particle_count * self._particle_bytes() + self._rows(worlds) * self._grid_bytes()
        return step_count * self.scene.substeps * substep

    def memory_estimate(self, step_count: int, *, worlds: int | None = None) -> int:
        """Bytes that a rollout and its `vjp` hold at their peak; see `Simulator.memory_estimate`."""
        worlds = worlds or self.batch_size
        count = self.scene.particle_count
        particles = count * self._particle_bytes()
        snapshots = (step_count + 1) * count * 3 * self.dtype.itemsize
        # lanes at work at the same time, each with a velocity grid, a gradient grid and, where it computes a step anew, its records
        active = worlds if self.device.type != "cpu" else (self.threads if worlds >= self.threads else 1)
        work = active * (1 + self._rows(worlds)) * self._grid_bytes()
        history = worlds * self._history_bytes(step_count, worlds)
        if history > self.memory_budget:
            history = worlds * step_count * particles + active * self._history_bytes(1, worlds)
        # snapshots and the caller's gradient of them; initial state, twice where the checkpoints hold it, too; final state, a
        # gradient, and what a substep makes
        common = 2 * snapshots + (4 if self._slots is not None else 5) * particles
        if self._slots is not None:  # a slot has the gradients of the snapshots and of the end, the end and its gradient once more
            common += snapshots + 3 * particles
        return history + work + worlds * common


def _initialize_warp() -> None:
    """Start Warp without its banner and its line per loaded module, unless the user asked for more than the default."""
    if wp.config.log_level == wp.LOG_INFO:
        wp.config.log_level = wp.LOG_WARNING
    if wp.config.kernel_cache_dir is None:
        setting = "WARP_CACHE_PATH"
        usual = Path(os.environ[setting]) if setting in os.environ else user_cache() / "warp"
        chosen = cache_folder(usual, setting=setting)
        if chosen != usual:
            wp.config.kernel_cache_dir = str(chosen)
    wp.init()
