"""Captured rollouts: static arrays, work that is recorded once and replayed, and slots that live trajectories own.

On CUDA a rollout is thousands of short kernels, and launching them one by one from Python takes longer than they run. A
`RolloutSlot` holds every array of a rollout and of its vjp at a fixed place, so that both can be captured as a CUDA graph and
replayed with new inputs copied in. What captures is given from outside: the tests replay on the CPU by launching again.
"""

from __future__ import annotations

import collections
import contextlib
import gc
import threading
import warnings
import weakref
from collections.abc import Callable, Iterator
from typing import Any, Generic, NamedTuple, TypeVar

import torch
import warp
from torch import Tensor

from cpdeform.backends.warp.lane import Lane, Particles, Program, Substep
from cpdeform.core.simulator import RolloutGradient
from cpdeform.core.state import State

Launch = Callable[[], None]
Capture = Callable[[Launch], Launch]
"""Records what a function launches, without running it, and returns a function that replays it."""
Slot = TypeVar("Slot")
Result = TypeVar("Result")

MOST_FREE = 4
"""Slots that wait for a rollout of their shape; above it the one unused for longest is dropped."""

wp: Any = warp  # Warp's own functions carry no annotations


class Graphs:
    """Captures work until that fails once; without `capture` everything is launched one by one."""

    def __init__(self, capture: Capture | None) -> None:
        self._capture = capture

    def attempt(self, launch: Launch) -> Launch | None:
        """Record `launch` and replay it once; None where that fails, and then the work is still to be done."""
        if self._capture is None:
            return None
        try:
            replay = self._capture(launch)
            # a graph is built in full only when it is replayed for the first time, so this belongs to the attempt
            replay()
        except Exception as error:
            self._capture = None
            message = f"CUDA graphs do not work here, so kernels are launched one by one from now on: {error}"
            warnings.warn(message, RuntimeWarning, stacklevel=2)
            return None
        return replay


class Recorded:
    """One piece of work on static arrays: launched the first time, captured the second, replayed from then on.

    The first time loads what is loaded lazily, makes arrays, and spares the capture where the work is done only once. The work is
    given with each call rather than held, since a slot that its parts refer to would keep its memory until a garbage collection.

    Args:
        graphs: What captures.
    """

    def __init__(self, graphs: Graphs) -> None:
        self._graphs = graphs
        self._warm = False
        self._replay: Launch | None = None

    def run(self, launch: Launch) -> None:
        """Do the work; `launch` is the same each time, and reads nothing that it writes."""
        if self._replay is not None:
            self._replay()
            return
        if self._warm:
            self._replay = self._graphs.attempt(launch)
            if self._replay is not None:
                return
        launch()
        self._warm = True


class Arena:
    """Arrays that are made once, and given again in the same order after each `rewind`; see `lane.Arrays`.

    Args:
        make: Makes an array of a shape and a Warp type.
    """

    def __init__(self, make: Callable[[tuple[int, ...], Any], Any]) -> None:
        self._make = make
        self._kept: list[Any] = []
        self._scratch: dict[str, Any] = {}
        self._next = 0

    def rewind(self) -> None:
        """Give the kept arrays from the first one on again."""
        self._next = 0

    def kept(self, shape: tuple[int, ...], dtype: Any, *, zero: bool = False) -> Any:
        """The next kept array; see `lane.Arrays.kept`."""
        if self._next == len(self._kept):
            self._kept.append(self._make(shape, dtype))
        array = self._kept[self._next]
        self._next += 1
        return self._ready(array, shape, dtype, zero=zero)

    def scratch(self, name: str, shape: tuple[int, ...], dtype: Any, *, zero: bool = False) -> Any:
        """The one array of this name; one stream orders those who use it."""
        if name not in self._scratch:
            self._scratch[name] = self._make(shape, dtype)
        return self._ready(self._scratch[name], shape, dtype, zero=zero)

    @staticmethod
    def _ready(array: Any, shape: tuple[int, ...], dtype: Any, *, zero: bool) -> Any:
        if tuple(array.shape) != shape or array.dtype is not dtype:
            raise RuntimeError(f"An arena was asked for {shape} of {dtype} where it gave {array.shape} of {array.dtype} before.")
        if zero:
            array.zero_()
        return array


class Lease(Generic[Slot]):
    """A slot in use. It goes back when nobody refers to the lease any more; trajectories hold theirs.

    Args:
        slot: The slot.
    """

    def __init__(self, slot: Slot) -> None:
        self.slot = slot


class SlotKey(NamedTuple):
    """What a slot is made for: worlds, environment steps, and whether all substeps' records are kept or computed anew."""

    worlds: int
    steps: int
    keep: bool


class SlotPool(Generic[Slot]):
    """Lends slots, and makes them where none of the wanted shape is free.

    Args:
        make: Makes a slot.
        most_free: The most slots that wait unused.
    """

    def __init__(self, make: Callable[[SlotKey], Slot], *, most_free: int = MOST_FREE) -> None:
        self._make = make
        self._most_free = most_free
        self._free: list[tuple[SlotKey, Slot]] = []
        # a lease may end in any thread and in the middle of anything, so its end takes no lock: appending is atomic
        self._returned: collections.deque[tuple[SlotKey, Slot]] = collections.deque()
        self._lock = threading.Lock()

    def take(self, key: SlotKey) -> Lease[Slot]:
        """A slot that nobody else uses until the lease ends."""
        slot = self._find(key) or self._make(key)
        lease = Lease(slot)
        end = weakref.finalize(lease, self._returned.append, (key, slot))
        end.atexit = False
        return lease

    def with_memory(self, work: Callable[[], Result]) -> Result:
        """Do `work`; where memory runs out, drop the slots that nobody uses and do it once more."""
        # the second attempt comes after the error is gone, whose frames refer to what the first one had made
        with contextlib.suppress(torch.cuda.OutOfMemoryError):
            return work()
        self.clear()
        return work()

    def _find(self, key: SlotKey) -> Slot | None:
        with self._lock:
            self._collect()
            for index in reversed(range(len(self._free))):
                if self._free[index][0] == key:
                    return self._free.pop(index)[1]
            del self._free[: max(len(self._free) - self._most_free, 0)]
            return None

    def _collect(self) -> None:
        while self._returned:
            self._free.append(self._returned.popleft())

    @property
    def free_count(self) -> int:
        """Slots that nobody uses."""
        return len(self._free) + len(self._returned)

    def clear(self) -> None:
        """Drop the slots that nobody uses."""
        with self._lock:
            self._collect()
            self._free.clear()


class RolloutSlot:
    """Every array of one rollout and its vjp, at fixed places.

    Args:
        program: Kernels and constants.
        key: Shape of the rollout.
        start: A state of any number of worlds, for sizes, type and device.
        action_size: Components of an action.
        graphs: What captures the work.
    """

    @torch.inference_mode(False)  # tensors made in inference mode could be written to nowhere else
    def __init__(self, program: Program, key: SlotKey, *, start: State, action_size: int, graphs: Graphs) -> None:
        self._program, self._key = program, key
        self._forward, self._backward = Recorded(graphs), Recorded(graphs)
        options: dict[str, Any] = {"dtype": start.position.dtype, "device": start.position.device}

        def make(shape: tuple[int, ...], dtype: Any) -> Any:
            return _view(torch.empty(shape + tuple(dtype._shape_), **options), dtype)

        self._arena = Arena(make)
        worlds, steps, _ = key
        count, tools = start.particle_count, start.tool_pose.shape[1]
        self._tool_count = tools
        frames, columns = steps * program.substeps + 1, max(tools, 1)
        self._lane = Lane(program, worlds=worlds, particle_count=count, arrays=self._arena, full_grid=True)
        self._records: tuple[tuple[Substep, ...], ...] = ()
        # the particles at the start of each step and at the end, the step first; row 0 is the input and the last the result
        shapes = tuple((worlds, *tensor.shape[1:]) for tensor in _particle_tensors(start))
        self._rows = tuple(torch.zeros(steps + 1, *shape, **options) for shape in shapes)
        self._particles = tuple(self._view_particles(row) for row in zip(*self._rows, strict=True))
        # where the end of a step that is computed a second time goes: it is known already, and sums on CUDA vary in the last digits
        self._spare = None if key.keep else self._view_particles(tuple(torch.empty(shape, **options) for shape in shapes))
        self._actions = torch.zeros(worlds, steps, action_size, **options)
        self._poses = torch.zeros(worlds, frames, columns, 8, **options)
        self._grad_positions = torch.zeros(steps + 1, worlds, count, 3, **options)
        self._grad_tools = torch.zeros(worlds, steps + 1, tools, 8, **options)
        # with respect to velocity, affine field and strain of the end; zero unless a vjp is given them
        self._grad_final = tuple(torch.zeros(shape, **options) for shape in shapes[1:])
        self._final_given = False
        self._gradient = _state([torch.zeros(shape, **options) for shape in (*shapes, (worlds, tools, 8))])
        self._grad_particles = self._view_particles(_particle_tensors(self._gradient))
        self._grad_actions = torch.zeros_like(self._actions)
        self._grad_poses = torch.zeros_like(self._poses)
        self._view_tools()

    def _view_particles(self, tensors: tuple[Tensor, ...]) -> Particles:
        types = self._program.types
        dtypes = (types.vec3, types.vec3, types.mat33, types.vec6)
        return Particles(*(_view(tensor, dtype) for tensor, dtype in zip(tensors, dtypes, strict=True)))

    def _view_tools(self) -> None:
        program, types = self._program, self._program.types
        self._poses_view, self._grad_poses_view = _view(self._poses, types.vec8), _view(self._grad_poses, types.vec8)
        self._tool_inputs: tuple[Any, ...] = ()
        self._tool_gradients: tuple[Any, ...] = ()
        if self._tool_count:
            self._tool_inputs = (_view(self._actions, types.real), program.tools, program.substeps, self._poses_view)
            start = _view(self._gradient.tool_pose, types.vec8)
            self._tool_gradients = (self._grad_poses_view, _view(self._grad_actions, types.real), start)

    def rollout(self, state: State, actions: Tensor) -> tuple[Tensor, Tensor, State]:
        """Simulate; see `Simulator.rollout`.

        Args:
            state: Start of W worlds.
            actions: Actions (W, T, A).

        Returns:
            Positions (W, T+1, N, 3), tool poses (W, T+1, M, 8) and the final state, all of them copies.
        """
        tools = self._tool_count
        for rows, tensor in zip(self._rows, _particle_tensors(state), strict=True):
            rows[0].copy_(tensor)
        self._poses[:, 0, :tools].copy_(state.tool_pose)
        self._actions.copy_(actions)
        self._forward.run(self._launch_rollout)
        # a transposed tensor of one world counts as contiguous already, and `contiguous` would then copy nothing
        positions = self._rows[0].transpose(0, 1).clone(memory_format=torch.contiguous_format)
        poses = self._poses[:, :: self._program.substeps, :tools].clone(memory_format=torch.contiguous_format)
        return positions, poses, _state([*(rows[-1].clone() for rows in self._rows), poses[:, -1].clone()])

    def vjp(self, grad_positions: Tensor, grad_tools: Tensor | None, final: State | None = None) -> RolloutGradient:
        """Pull gradients back through the last rollout; see `Simulator.vjp`. The gradients are copies.

        Args:
            grad_positions: Gradient (W, T+1, N, 3).
            grad_tools: Gradient (W, T+1, M, 8); None for zero.
            final: Gradient with respect to the final state, of whose positions and poses the other two know; None for zero.
        """
        self._grad_positions.copy_(grad_positions.transpose(0, 1))
        if grad_tools is None:
            self._grad_tools.zero_()
        else:
            self._grad_tools.copy_(grad_tools)
        if final is not None:
            for kept, given in zip(self._grad_final, _particle_tensors(final)[1:], strict=True):
                kept.copy_(given)
        elif self._final_given:
            for kept in self._grad_final:
                kept.zero_()
        self._final_given = final is not None
        self._backward.run(self._launch_vjp)
        return RolloutGradient(actions=self._grad_actions.clone(), initial_state=self._gradient.clone())

    def _launch(self, kernel: Any, inputs: tuple[Any, ...]) -> None:
        wp.launch(kernel, dim=(self._key.worlds, self._tool_count), inputs=list(inputs), device=self._program.device)

    def _launch_rollout(self) -> None:
        """All of a rollout. It may be captured: it makes no tensor, waits for nothing and takes no number from the device."""
        if self._tool_inputs:
            self._launch(self._program.kernels.move_tools, self._tool_inputs)
        self._arena.rewind()
        records = []
        for step in range(self._key.steps):
            made = self._launch_step(step, self._particles[step + 1])
            if self._key.keep:
                records.append(made)
            else:
                self._arena.rewind()
        self._records = tuple(records)

    def _launch_step(self, step: int, end: Particles) -> tuple[Substep, ...]:
        records, particles, substeps = [], self._particles[step], self._program.substeps
        for index in range(substeps):
            after = end if index == substeps - 1 else None
            record, particles = self._lane.forward(particles, self._poses_view, step * substeps + index, after)
            records.append(record)
        return tuple(records)

    def _launch_vjp(self) -> None:
        """All of a vjp; see `_launch_rollout` for what it may not do."""
        gradient, steps = self._gradient, self._key.steps
        for tensor in (gradient.tool_pose, self._grad_actions, self._grad_poses):
            tensor.zero_()
        for tensor, last in zip(_particle_tensors(gradient), (self._grad_positions[steps], *self._grad_final), strict=True):
            tensor.copy_(last)
        after = self._particles[steps].velocity
        for step in reversed(range(steps)):
            after = self._launch_vjp_step(step, after)
            gradient.position.add_(self._grad_positions[step])
        if self._tool_inputs:
            frames = self._grad_poses[:, :: self._program.substeps, : self._tool_count]
            frames.add_(self._grad_tools)
            self._launch(self._program.kernels.move_tools_adjoint, (*self._tool_inputs, *self._tool_gradients))
        # the kernels hold the strain's gradient as a symmetric matrix; the state's off-diagonal numbers stand for two entries
        gradient.elastic_strain[..., 3:].mul_(2.0)

    def _launch_vjp_step(self, step: int, after: Any) -> Any:
        """Adjoint of one step; returns the velocities before it."""
        if self._spare is None:
            records = self._records[step]
        else:
            self._arena.rewind()
            records = self._launch_step(step, self._spare)
        first = step * self._program.substeps
        for index in reversed(range(self._program.substeps)):
            self._lane.backward(records[index], after, self._poses_view, first + index, self._grad_particles, self._grad_poses_view)
            after = records[index].particles.velocity
        return after


def _particle_tensors(state: State) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    return (state.position, state.velocity, state.affine, state.elastic_strain)


def _state(tensors: list[Tensor]) -> State:
    position, velocity, affine, strain, pose = tensors
    return State(position, velocity, affine, strain, pose)


def _view(tensor: Tensor, dtype: Any) -> Any:
    return wp.from_torch(tensor, dtype=dtype, requires_grad=False)


def capture_on_cuda(device: torch.device) -> Capture:
    """What captures CUDA graphs on a device; to be called, as its replays, where Warp's stream is torch's current one."""

    def capture(launch: Launch) -> Launch:
        # torch's usual stream is the legacy default one, which cannot be captured. Capturing runs nothing, so any other stream will
        # do, and needs no order with the usual one. Torch's are not blocking: what other threads do meanwhile on the default
        # stream does not end the capture. Warp forgets a stream when any wrapper of it goes, hence not the current one again.
        side: Any = torch.cuda.Stream(device)  # type: ignore[no-untyped-call]
        if side == torch.cuda.current_stream(device):
            side = torch.cuda.Stream(device)  # type: ignore[no-untyped-call]
        stream = wp.stream_from_torch(side)
        with (
            _no_garbage_collection(),
            torch.cuda.stream(side),
            wp.ScopedStream(stream, sync_enter=False),
            # the warm-up has loaded the kernels; Warp would otherwise load all modules of the process on older drivers
            wp.ScopedCapture(stream=stream, force_module_load=False) as recording,
        ):
            launch()
        graph = recording.graph
        return lambda: wp.capture_launch(graph)

    return capture


@contextlib.contextmanager
def _no_garbage_collection() -> Iterator[None]:
    """Collect nothing: freeing what happens to lie around may call CUDA, which a capture does not survive."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()
