"""Captured rollouts of the Warp backend, on the CPU with a tape in place of CUDA graphs, and on CUDA where there is one."""

from __future__ import annotations

import contextlib
import functools
import gc
import warnings
import weakref
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import pytest
import torch
from backend_cases import CASES, actions_for, floating, stirred
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from cpdeform.core.simulator import RolloutGradient, Trajectory
from cpdeform.core.state import State

wp = pytest.importorskip("warp")

from cpdeform.backends.warp.graph import Arena, Graphs, Recorded, SlotKey, SlotPool  # noqa: E402
from cpdeform.backends.warp.simulator import SimulatorWarp  # noqa: E402

SCENES = {**CASES, "no tools": floating()}
Check = Callable[[Any, Any], None]
needs_cuda = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")


class Tape(TorchDispatchMode):
    """Writes down what is launched, by Warp and by torch, without doing it; raises on what a CUDA graph cannot hold."""

    def __init__(self) -> None:
        super().__init__()
        self.calls: list[Callable[[], Any]] = []

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        schema = function._schema
        if schema.is_mutable:
            self.calls.append(functools.partial(function, *args, **(kwargs or {})))
            return args[0]
        if not all(result.alias_info is not None for result in schema.returns):
            raise RuntimeError(f"{schema.name} makes a tensor")
        return function(*args, **(kwargs or {}))

    def replay(self) -> None:
        for call in self.calls:
            call()

    @contextlib.contextmanager
    def recording(self) -> Iterator[None]:
        launch, fill = wp.launch, wp.array.zero_

        def forbidden(*args: Any, **kwargs: Any) -> None:
            raise RuntimeError("an array is made or read during the capture")

        with pytest.MonkeyPatch.context() as patch, self:
            patch.setattr(wp, "launch", lambda *args, **kwargs: self.calls.append(functools.partial(launch, *args, **kwargs)))
            patch.setattr(wp.array, "zero_", lambda array: self.calls.append(functools.partial(fill, array)))
            for name in ("empty", "zeros", "from_torch", "to_torch", "copy"):
                patch.setattr(wp, name, forbidden)
            yield


def tape_capture(launch: Callable[[], None]) -> Callable[[], None]:
    tape = Tape()
    with tape.recording():
        launch()
    assert tape.calls
    return tape.replay


def plain(case: str, **options: Any) -> SimulatorWarp:
    return SimulatorWarp(SCENES[case], **{"batch_size": 3, "threads": 1, "dtype": torch.float64, **options})


def slotted(case: str, capture: Any = tape_capture, **options: Any) -> SimulatorWarp:
    simulator = plain(case, **options)
    simulator._slots = simulator._make_slots(capture)
    return simulator


def gradients_for(trajectory: Trajectory, seed: int = 3) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    tensors = (trajectory.positions, trajectory.tool_poses)
    return tuple(torch.randn(tensor.shape, generator=generator, dtype=torch.float64).to(tensor) for tensor in tensors)  # type: ignore[return-value]


def inputs(simulator: SimulatorWarp, *, worlds: int = 2, steps: int = 2, seed: int = 1) -> tuple[State, Tensor]:
    state = stirred(simulator, batch_size=worlds, seed=seed)
    return state, actions_for(simulator, batch_size=worlds, steps=steps, seed=seed).to(simulator.device)


def tensors_of(made: Trajectory | RolloutGradient) -> list[Tensor]:
    state = made.final_state if isinstance(made, Trajectory) else made.initial_state
    found = [state.position, state.velocity, state.affine, state.elastic_strain, state.tool_pose]
    return [*found, *((made.positions, made.tool_poses) if isinstance(made, Trajectory) else (made.actions,))]


def assert_equal(made: Trajectory | RolloutGradient, expected: Trajectory | RolloutGradient) -> None:
    for tensor, other in zip(tensors_of(made), tensors_of(expected), strict=True):
        assert torch.equal(tensor, other)


def test_an_arena_gives_the_same_arrays_in_the_same_order() -> None:
    arena = Arena(lambda shape, dtype: wp.full(shape, 7.0, dtype=dtype, device="cpu"))
    first = [arena.kept((2, size), wp.float64) for size in (3, 4)]
    scratch = arena.scratch("velocity", (2, 3), wp.float64)
    arena.rewind()
    again = [arena.kept((2, 3), wp.float64, zero=True), arena.kept((2, 4), wp.float64)]
    assert all(array is other for array, other in zip(first, again, strict=True))
    assert not first[0].numpy().any()
    assert (first[1].numpy() == 7.0).all()
    assert arena.scratch("velocity", (2, 3), wp.float64) is scratch
    assert arena.kept((2, 3), wp.float64) is not first[0]
    arena.rewind()
    with pytest.raises(RuntimeError, match="arena"):
        arena.kept((2, 4), wp.float64)


class Thing:
    """A slot that does nothing."""


def test_a_slot_in_use_is_not_lent_again() -> None:
    made: list[SlotKey] = []

    def make(key: SlotKey) -> Thing:
        made.append(key)
        return Thing()

    pool = SlotPool(make, most_free=1)
    key = SlotKey(2, 3, True)
    first, second = pool.take(key), pool.take(key)
    assert first.slot is not second.slot
    kept = first.slot
    del first
    assert pool.free_count == 1
    third = pool.take(key)
    assert third.slot is kept
    assert pool.take(key._replace(steps=4)).slot is not kept
    assert made == [key, key, key._replace(steps=4)]
    del second, third
    assert pool.free_count == 3
    pool.take(key._replace(worlds=1))  # what nobody of this shape wants is dropped down to one
    assert pool.free_count == 2
    pool.clear()
    assert pool.free_count == 0


def test_free_slots_go_where_memory_is_short() -> None:
    pool = SlotPool(lambda key: Thing())
    seen: list[int] = []

    def work() -> str:
        lease = pool.take(SlotKey(1, 2, True))
        seen.append(pool.free_count)
        if pool.free_count:
            raise torch.cuda.OutOfMemoryError("out of memory")
        return type(lease.slot).__name__

    pool.take(SlotKey(1, 1, True))
    # the slot of the failed attempt goes as well
    assert pool.with_memory(work) == "Thing"
    assert seen == [1, 0]
    assert pool.free_count == 1


def test_work_is_launched_then_captured_then_replayed() -> None:
    events: list[str] = []

    def capture(launch: Callable[[], None]) -> Callable[[], None]:
        events.append("capture")
        return lambda: events.append("replay")

    work = Recorded(Graphs(capture))
    for _ in range(3):
        work.run(lambda: events.append("launch"))
    assert events == ["launch", "capture", "replay", "replay"]


@pytest.mark.parametrize("where", ["capture", "replay"])
def test_after_a_failure_all_work_is_launched(where: str) -> None:
    events: list[str] = []

    def fail() -> None:
        events.append("replay")
        raise RuntimeError("no such luck")

    def capture(launch: Callable[[], None]) -> Callable[[], None]:
        events.append("capture")
        if where == "capture":
            raise RuntimeError("no such luck")
        return fail

    graphs = Graphs(capture)
    work, other = Recorded(graphs), Recorded(graphs)
    work.run(lambda: events.append("launch"))
    with pytest.warns(RuntimeWarning, match="no such luck"):
        work.run(lambda: events.append("launch"))
    work.run(lambda: events.append("launch"))
    for _ in range(2):
        other.run(lambda: events.append("other"))
    tried = ["capture"] if where == "capture" else ["capture", "replay"]
    assert events == ["launch", *tried, "launch", "launch", "other", "other"]


@pytest.mark.parametrize("budget", [0, 1 << 29])
@pytest.mark.parametrize("case", ["two tools", "rolling pin", "no tools"])
def test_replays_equal_launches_bit_for_bit(case: str, budget: int) -> None:
    dtype = torch.float32 if case == "no tools" else torch.float64
    options: dict[str, Any] = {"memory_budget": budget, "dtype": dtype}
    expecting, simulator = plain(case, graphs=True, **options), slotted(case, **options)
    assert expecting._slots is None
    for seed in range(4):
        state, actions = inputs(expecting, seed=seed)
        expected, made = expecting.rollout(state, actions), simulator.rollout(state, actions)
        assert_equal(made, expected)
        grad_positions, grad_poses = gradients_for(expected, seed)
        poses = grad_poses if seed % 2 else None
        expected_gradient = expecting.vjp(expected, grad_positions, poses)
        for _ in range(2):
            assert_equal(simulator.vjp(made, grad_positions, poses), expected_gradient)


@pytest.mark.parametrize("budget", [0, 1 << 29])
def test_the_gradient_of_the_final_state_comes_and_goes(budget: int) -> None:
    expecting, simulator = plain("two tools", memory_budget=budget), slotted("two tools", memory_budget=budget)
    generator = torch.Generator().manual_seed(7)
    for given in (False, True, False, True, True, False):
        expected, made = (each.rollout(*inputs(expecting)) for each in (expecting, simulator))
        gradient, poses = gradients_for(expected)
        end = expected.final_state.map(lambda tensor: torch.randn(tensor.shape, generator=generator).to(tensor)) if given else None
        assert_equal(
            simulator.vjp(made, gradient, poses, grad_final_state=end),
            expecting.vjp(expected, gradient, poses, grad_final_state=end),
        )
        del made


@pytest.mark.parametrize("budget", [0, 1 << 29])
def test_warp_itself_captures_a_rollout(budget: int) -> None:
    captures: list[Any] = []

    def capture(launch: Callable[[], None]) -> Callable[[], None]:
        with wp.ScopedCapture(device="cpu", force_module_load=False) as recording:
            launch()
        captures.append(recording.graph)
        return lambda: wp.capture_launch(captures[0])

    expecting, simulator = plain("two tools", memory_budget=budget), slotted("two tools", capture, memory_budget=budget)
    for seed in range(4):
        given = inputs(expecting, seed=seed)
        assert_equal(simulator.rollout(*given), expecting.rollout(*given))
    assert len(captures) == 1


def follow(simulator: SimulatorWarp, expecting: SimulatorWarp, check: Check, shapes: Sequence[tuple[int, int]]) -> None:
    """Compare rollouts and gradients while three trajectories are alive."""
    for worlds, steps in shapes:
        given = [inputs(expecting, worlds=worlds, steps=steps, seed=seed) for seed in range(3)]
        made = [simulator.rollout(*pair) for pair in given]
        # memory that is given back leaves the trajectories as they are
        simulator.release_memory()
        expected = [expecting.rollout(*pair) for pair in given]
        gradient, poses = gradients_for(expected[0])
        results = [simulator.vjp(trajectory, gradient, poses) for trajectory in made]
        for trajectory, other, result in zip(made, expected, results, strict=True):
            check(trajectory, other)
            check(result, expecting.vjp(other, gradient, poses))
        del made, trajectory
        assert simulator._slots is not None
        assert simulator._slots.free_count == 3


@pytest.mark.parametrize("budget", [0, 1 << 29])
def test_live_trajectories_and_shapes_do_not_share(budget: int) -> None:
    expecting, simulator = plain("sphere", memory_budget=budget), slotted("sphere", memory_budget=budget)
    follow(simulator, expecting, assert_equal, [(2, 2), (2, 2), (2, 2), (1, 1), (2, 2), (3, 1)])


@pytest.mark.parametrize("after", [0, 1])
def test_where_capturing_fails_results_are_right(after: int) -> None:
    captures: list[int] = []

    def capture(launch: Callable[[], None]) -> Callable[[], None]:
        captures.append(1)
        if len(captures) <= after:
            return tape_capture(launch)
        tape_capture(launch)
        raise RuntimeError("operation not permitted when stream is capturing")

    expecting, simulator = plain("sphere"), slotted("sphere", capture)
    reports = []
    for seed in range(4):
        given = inputs(expecting, seed=seed)
        expected = expecting.rollout(*given)
        gradient, _ = gradients_for(expected)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            made = simulator.rollout(*given)
            result = simulator.vjp(made, gradient)
        reports += [str(warning.message) for warning in caught]
        assert_equal(made, expected)
        assert_equal(result, expecting.vjp(expected, gradient))
        del made
    assert len(captures) == after + 1
    assert len(reports) == 1
    assert "not permitted" in reports[0]


def test_what_is_given_out_does_not_change() -> None:
    simulator = slotted("sphere")
    trajectory = simulator.rollout(*inputs(simulator, worlds=1))
    gradient = simulator.vjp(trajectory, torch.ones_like(trajectory.positions))
    held = tensors_of(trajectory) + tensors_of(gradient)
    before = [tensor.clone() for tensor in held]
    del trajectory
    for seed in range(3):
        other = simulator.rollout(*inputs(simulator, worlds=1, seed=seed))
        simulator.vjp(other, torch.ones_like(other.positions))
        del other
    assert all(torch.equal(tensor, old) for tensor, old in zip(held, before, strict=True))


def test_a_slot_goes_without_a_garbage_collection() -> None:
    simulator = slotted("sphere", None)
    trajectory = simulator.rollout(*inputs(simulator))
    simulator.vjp(trajectory, torch.ones_like(trajectory.positions))
    slot = weakref.ref(trajectory.checkpoints[0].slot)
    gc.disable()
    try:
        simulator.release_memory()
        assert slot() is not None
        del trajectory
        simulator.release_memory()
        assert slot() is None
    finally:
        gc.enable()


def test_inference_mode_leaves_slots_usable() -> None:
    expecting, simulator = plain("sphere"), slotted("sphere")
    given = inputs(expecting)
    for mode in (True, False, True):
        with torch.inference_mode(mode):
            made = simulator.rollout(*given)
        assert_equal(made, expecting.rollout(*given))
        del made


def assert_near(made: Any, expected: Any) -> None:
    for tensor, other in zip(tensors_of(made), tensors_of(expected), strict=True):
        torch.testing.assert_close(tensor.cpu(), other.cpu(), rtol=1e-6, atol=1e-9 * max(1.0, float(other.abs().max())))


@pytest.mark.cuda
@needs_cuda
@pytest.mark.parametrize("budget", [0, 1 << 29])
@pytest.mark.parametrize("case", ["two tools", "fixed tool", "rolling pin"])
def test_graphs_follow_launches_and_the_cpu(case: str, budget: int) -> None:
    cpu = plain(case, memory_budget=budget)
    launched, captured = (plain(case, device="cuda", graphs=graphs, memory_budget=budget) for graphs in (False, True))
    for seed in range(4):
        given = inputs(cpu, seed=seed)
        expected = cpu.rollout(*given)
        gradient, poses = gradients_for(expected, seed)
        expected_gradient = cpu.vjp(expected, gradient, poses)
        for simulator in (launched, captured):
            made = simulator.rollout(*given)
            assert_near(made, expected)
            for _ in range(2):
                assert_near(simulator.vjp(made, gradient, poses), expected_gradient)
            del made


@pytest.mark.cuda
@needs_cuda
def test_graphs_are_captured(monkeypatch: pytest.MonkeyPatch) -> None:
    replays: list[int] = []
    capture_launch = wp.capture_launch
    monkeypatch.setattr(wp, "capture_launch", lambda *args, **kwargs: (replays.append(1), capture_launch(*args, **kwargs)))
    simulator = plain("sphere", device="cuda")
    for seed in range(3):
        trajectory = simulator.rollout(*inputs(simulator, seed=seed))
        simulator.vjp(trajectory, torch.ones_like(trajectory.positions))
        del trajectory
    # a warning about a failed capture is an error here
    assert len(replays) == 4


@pytest.mark.cuda
@needs_cuda
def test_live_trajectories_and_shapes_on_cuda() -> None:
    follow(plain("sphere", device="cuda"), plain("sphere"), assert_near, [(2, 2), (2, 2), (2, 2), (1, 1), (2, 2), (3, 1)])


@pytest.mark.cuda
@needs_cuda
def test_streams_may_change_between_rollouts() -> None:
    cpu, simulator = plain("sphere"), plain("sphere", device="cuda")
    for seed in range(4):
        expected = cpu.rollout(*(given := inputs(cpu, seed=seed)))
        gradient, _ = gradients_for(expected)
        stream = torch.cuda.Stream() if seed % 2 else torch.cuda.default_stream()
        with torch.cuda.stream(stream):
            made = simulator.rollout(*given)
            result = simulator.vjp(made, gradient)
        stream.synchronize()
        assert_near(made, expected)
        assert_near(result, cpu.vjp(expected, gradient))
        del made, result
