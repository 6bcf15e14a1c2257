"""Checks of what a simulator promises besides its physics: shapes, states, batches, declarations, errors."""

from __future__ import annotations

import dataclasses
import tempfile
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from cpdeform.core.errors import CapabilityError, InputError
from cpdeform.core.simulator import Simulator, Trajectory
from cpdeform.core.state import State
from cpdeform.planning.result import StageResult, Status
from cpdeform.run.record_stage import read_stage, write_stage
from cpdeform.testing.report import CheckItem, Finding, Skip, complaint_unless_raised, violations
from cpdeform.testing.simulator_bench import (
    EXAMPLES,
    SimulatorBench,
    default_scene,
    example_tool,
    largest_difference,
    no_actions,
    random_actions,
    resting,
    state_difference,
    stirred,
)


def check_shapes(bench: SimulatorBench) -> Finding:
    """Shapes, types and devices of a trajectory, and what its parts have in common."""
    simulator = bench.make(bench.scene, batch_size=2)
    state, actions = stirred(simulator, batch_size=2), random_actions(simulator, batch_size=2, steps=3)
    trajectory = simulator.rollout(state, actions)
    particles, tools = bench.scene.particle_count, len(bench.scene.tools)
    expected = {"positions": (2, 4, particles, 3), "tool_poses": (2, 4, tools, 8), "actions": tuple(actions.shape)}
    complaints = []
    for name, shape in expected.items():
        tensor = getattr(trajectory, name)
        complaints += _tensor_complaints(f"Trajectory.{name}", tensor, shape, simulator)
    for name in ("initial_state", "final_state"):
        complaints += _state_complaints(f"Trajectory.{name}", getattr(trajectory, name), state, simulator)
    return violations(complaints or _end_complaints(trajectory, state))


def _tensor_complaints(name: str, tensor: Tensor, shape: tuple[int, ...], simulator: Simulator) -> list[str]:
    complaints = []
    if tuple(tensor.shape) != shape:
        complaints.append(f"{name} has shape {tuple(tensor.shape)} instead of {shape}")
    if tensor.dtype != simulator.dtype:
        complaints.append(f"{name} is {tensor.dtype} instead of {simulator.dtype}")
    if tensor.device.type != simulator.device.type:
        complaints.append(f"{name} is on {tensor.device} instead of {simulator.device}")
    if tensor.requires_grad:
        complaints.append(f"{name} is part of an autograd graph")
    return complaints


def _state_complaints(name: str, state: State, like: State, simulator: Simulator) -> list[str]:
    complaints = []
    for field in dataclasses.fields(State):
        shape = tuple(getattr(like, field.name).shape)
        complaints += _tensor_complaints(f"{name}.{field.name}", getattr(state, field.name), shape, simulator)
    return complaints


def _end_complaints(trajectory: Trajectory, state: State) -> list[str]:
    pairs = {
        "positions[:, 0] is not the start": (trajectory.positions[:, 0], state.position),
        "positions[:, -1] is not final_state.position": (trajectory.positions[:, -1], trajectory.final_state.position),
        "tool_poses[:, 0] is not the start": (trajectory.tool_poses[:, 0], state.tool_pose),
        "tool_poses[:, -1] is not final_state's": (
            trajectory.tool_poses[:, -1],
            trajectory.final_state.tool_pose,
        ),
        "initial_state is not the start": (trajectory.initial_state.position, state.position),
    }
    return [text for text, (first, second) in pairs.items() if not torch.allclose(first, second, rtol=0.0, atol=1e-6)]


def check_inputs_untouched(bench: SimulatorBench) -> Finding:
    """A rollout leaves state and actions as they were."""
    simulator = bench.make(bench.scene)
    state, actions = stirred(simulator), random_actions(simulator)
    kept_state, kept_actions = state.clone(), actions.clone()
    simulator.rollout(state, actions)
    return Finding(max(state_difference(state, kept_state), largest_difference(actions, kept_actions)), 0.0)


def check_fork(bench: SimulatorBench) -> Finding:
    """Clones and forks of a state in mid-flight go on as the original does."""
    simulator = bench.make(bench.scene, batch_size=2)
    actions = random_actions(simulator)
    middle = simulator.rollout(stirred(simulator), actions).final_state
    plain = simulator.rollout(middle, actions).final_state
    converted = middle.map(lambda tensor: tensor.double().contiguous()).to(dtype=simulator.dtype)
    cloned = simulator.rollout(converted.clone(), actions).final_state
    forked = simulator.rollout(middle.fork(2), actions.expand(2, -1, -1)).final_state
    figures = [state_difference(other, plain) for other in (cloned, forked.select(0), forked.select(1))]
    return Finding(max(figures), bench.bound(1e-9, 1e-3))


def check_record(bench: SimulatorBench) -> Finding:
    """A state that went through the file of a run record continues as the one that did not."""
    simulator = bench.make(bench.scene)
    start, actions = stirred(simulator), random_actions(simulator)
    trajectory = simulator.rollout(start, actions)
    middle = trajectory.final_state
    expected = simulator.rollout(middle, actions).final_state
    with tempfile.TemporaryDirectory() as directory:
        path = Path(directory) / "stage-000.h5"
        write_stage(path, _stage_result(start, trajectory))
        read = read_stage(path).state.to(device=simulator.device)
    if state_difference(read, middle) > 0.0:
        return Finding(state_difference(read, middle), 0.0, "the state read from the file")
    after = simulator.rollout(read, actions).final_state
    return Finding(state_difference(after, expected), bench.bound(1e-9, 1e-3), "the rollout from it")


def _stage_result(start: State, trajectory: Trajectory) -> StageResult:
    return StageResult(
        index=0,
        status=Status.FINISHED,
        state_before=start,
        state=trajectory.final_state,
        priorities=torch.zeros(start.particle_count),
        candidates=(),
        best=None,
        actions=trajectory.actions[0],
        positions=trajectory.positions[0],
        tool_poses=trajectory.tool_poses[0],
        loss_before=0.0,
        loss=0.0,
        gradient_evaluations=0,
        history=(),
        seconds={},
    )


def check_halves(bench: SimulatorBench) -> Finding:
    """A rollout of 2T steps is a rollout of T steps twice."""
    simulator = bench.make(bench.scene)
    state, actions = stirred(simulator), random_actions(simulator, steps=4)
    whole = simulator.rollout(state, actions)
    first = simulator.rollout(state, actions[:, :2])
    second = simulator.rollout(first.final_state, actions[:, 2:])
    figures = (
        largest_difference(second.positions, whole.positions[:, 2:]),
        largest_difference(second.tool_poses, whole.tool_poses[:, 2:]),
        1e-2 * largest_difference(second.final_state.elastic_strain, whole.final_state.elastic_strain),
    )
    return Finding(max(figures), bench.bound(1e-10, 1e-5))


def check_batch(bench: SimulatorBench) -> Finding:
    """Worlds of a batch know nothing of each other."""
    simulator = bench.make(bench.scene, batch_size=3)
    state, actions = stirred(simulator, batch_size=3), random_actions(simulator, batch_size=3)
    together = simulator.rollout(state, actions)
    alone = [simulator.rollout(state.select(world), actions[world : world + 1]) for world in range(3)]
    figures = []
    for name in ("positions", "tool_poses"):
        figures += [largest_difference(getattr(one, name)[0], getattr(together, name)[world]) for world, one in enumerate(alone)]
    return Finding(max(figures), bench.bound(1e-10, 1e-5))


def check_determinism(bench: SimulatorBench) -> Finding:
    """A repeated rollout is equal bit for bit."""
    if bench.device.type not in bench.capabilities.deterministic_devices:
        raise Skip(f"It does not declare that it is deterministic on {bench.device.type}.")
    simulator = bench.make(bench.scene, batch_size=2)
    state, actions = stirred(simulator, batch_size=2), random_actions(simulator, batch_size=2)
    first, second = simulator.rollout(state, actions), simulator.rollout(state, actions)
    moments = largest_difference(first.positions, second.positions)
    return Finding(max(moments, state_difference(first.final_state, second.final_state)), 0.0)


def check_capabilities(bench: SimulatorBench) -> Finding:
    """What is declared runs, what is not is refused."""
    can, complaints = bench.capabilities, []
    for dtype in can.dtypes:
        simulator = bench.factory(bench.scene, batch_size=1, device=bench.device, dtype=dtype)
        positions = simulator.rollout(simulator.initial_state(), no_actions(simulator)).positions
        if positions.dtype != dtype or not bool(torch.isfinite(positions).all()):
            complaints.append(f"declares {dtype} but computes {positions.dtype} or numbers that are not finite")
    refused = {dtype for dtype in (torch.float16, torch.bfloat16, torch.float32, torch.float64) if dtype not in can.dtypes}
    for dtype in sorted(refused, key=str):
        complaints += complaint_unless_raised(
            lambda dtype=dtype: bench.factory(bench.scene, batch_size=1, device=bench.device, dtype=dtype),  # type: ignore[misc]
            CapabilityError,
            words=[str(dtype)],
            what=f"dtype {dtype}",
        )
    for device in {"cpu", "cuda", "mps"} - set(can.devices):
        complaints += complaint_unless_raised(
            lambda device=device: bench.factory(bench.scene, batch_size=1, device=device, dtype=bench.dtype),  # type: ignore[misc]
            CapabilityError,
            words=[device],
            what=f"device {device}",
        )
    return violations(complaints + _memory_complaints(bench) + _undeclared_kinds(bench))


def _memory_complaints(bench: SimulatorBench) -> list[str]:
    estimates = [bench.make(bench.scene).memory_estimate(steps) for steps in (1, 20)]
    grows = all(isinstance(estimate, int) for estimate in estimates) and 0 < estimates[0] <= estimates[1]
    return [] if grows else [f"memory_estimate(1), (20) are {estimates}, not numbers of bytes that grow"]


def _undeclared_kinds(bench: SimulatorBench) -> list[str]:
    complaints = []
    for kind in set(EXAMPLES) - set(bench.capabilities.tool_kinds):
        try:
            scene = resting(example_tool(kind))
        except Skip:
            continue
        complaints += complaint_unless_raised(lambda scene=scene: bench.make(scene), CapabilityError, words=[kind], what=kind)  # type: ignore[misc]
    return complaints


def check_kinds(bench: SimulatorBench) -> Finding:
    """Each declared kind of tool runs, and pushes the clay that it is pressed into."""
    if not bench.capabilities.tool_kinds:
        raise Skip("It declares no kind of tool.")
    complaints = []
    for kind in bench.capabilities.tool_kinds:
        simulator = bench.make(resting(example_tool(kind)))
        state, actions = simulator.initial_state(), random_actions(simulator)
        trajectory = simulator.rollout(state, actions)
        if not bool(torch.isfinite(trajectory.positions).all() & torch.isfinite(trajectory.tool_poses).all()):
            complaints.append(f"{kind}: not finite")
        if torch.equal(trajectory.tool_poses[:, 0], trajectory.tool_poses[:, -1]):
            complaints.append(f"{kind}: the tool does not move")
        still = simulator.rollout(state, torch.zeros_like(actions))
        if largest_difference(still.positions, trajectory.positions) < 1e-7:
            complaints.append(f"{kind}: the clay does not feel it")
    return violations(complaints)


def check_errors(bench: SimulatorBench) -> Finding:
    """Inputs that do not fit raise `InputError` with the argument's name."""
    simulator = bench.make(default_scene(bench.capabilities.tool_kinds[:1]))
    state, actions = simulator.initial_state(), random_actions(simulator)
    wide = torch.cat([actions, actions[..., :1]], dim=-1)
    fewer = State(**{field.name: getattr(state, field.name)[:, :-1] for field in dataclasses.fields(State)})
    fewer = dataclasses.replace(fewer, tool_pose=state.tool_pose)
    more = dataclasses.replace(state, tool_pose=torch.cat([state.tool_pose, torch.zeros(1, 1, 8).to(actions)], dim=1))
    cases = {
        "an action component too many": (lambda: simulator.rollout(state, wide), ["actions"]),
        "actions without an axis of worlds": (lambda: simulator.rollout(state, actions[0]), ["actions"]),
        "no step": (lambda: simulator.rollout(state, actions[:, :0]), ["actions"]),
        "actions of two worlds, state of one": (lambda: simulator.rollout(state, actions.expand(2, -1, -1)), ["actions", "state"]),
        "more worlds than batch_size": (lambda: simulator.rollout(state.fork(2), actions.expand(2, -1, -1)), ["batch_size"]),
        "a particle too few": (lambda: simulator.rollout(fewer, actions), ["state", "position"]),
        "a tool too many": (lambda: simulator.rollout(more, actions), ["state", "tool"]),
        "batch_size 0": (lambda: bench.make(bench.scene, batch_size=0), ["batch_size"]),
    }
    if bench.capabilities.differentiable:
        trajectory = simulator.rollout(state, actions)
        cases["gradient of other shape"] = (lambda: simulator.vjp(trajectory, trajectory.positions[:, 1:]), ["grad_positions"])
    complaints = []
    for what, (call, words) in cases.items():
        complaints += complaint_unless_raised(call, InputError, words=words, what=what)
    return violations(complaints)


def check_values_refused(bench: SimulatorBench) -> Finding:
    """Numbers that are not finite or make no sense raise `InputError` with the name of the tensor."""
    simulator = bench.make(default_scene(bench.capabilities.tool_kinds[:1]))
    state, actions = simulator.initial_state(), no_actions(simulator)
    cases = {f"nan in {name}": _spoilt(state, name, torch.nan) for name in ("position", "velocity", "affine", "elastic_strain")}
    cases |= {"an infinite velocity": _spoilt(state, "velocity", torch.inf), "a position of 1e6": _spoilt(state, "position", 1e6)}
    complaints = []
    if len(simulator.scene.tools):
        nothing = dataclasses.replace(state, tool_pose=state.tool_pose.clone())
        nothing.tool_pose[..., 3:7] = 0.0
        cases |= {"nan in a quaternion": _spoilt(state, "tool_pose", torch.nan, 5), "a quaternion of zeros": nothing}
        cases |= {"a tool at 1e6": _spoilt(state, "tool_pose", 1e6, 1)}
    for what, start in cases.items():
        call: Callable[[], object] = lambda start=start: simulator.rollout(start, actions)  # type: ignore[misc]  # noqa: E731
        complaints += complaint_unless_raised(call, InputError, words=["state."], what=what)
    for value in (torch.nan, 50.0, -1.5) if simulator.scene.action_size else ():
        plan = actions.clone()
        plan[0, -1, 0] = value
        call = lambda plan=plan: simulator.rollout(state, plan)  # type: ignore[misc]  # noqa: E731
        complaints += complaint_unless_raised(call, InputError, words=["actions"], what=f"an action of {value:g}")
    return violations(complaints)


def _spoilt(state: State, name: str, value: float, component: int = 0) -> State:
    """The state with another number in one place."""
    tensor = getattr(state, name).clone()
    tensor[0, -1].view(-1)[component] = value
    return dataclasses.replace(state, **{name: tensor})


CONTRACT_CHECKS: tuple[CheckItem[SimulatorBench], ...] = (
    CheckItem("shapes and types of the trajectory", check_shapes, "See the attributes of Trajectory and State."),
    CheckItem("state and actions are not modified", check_inputs_untouched, "Copy the inputs before writing to them."),
    CheckItem(
        "state can be cloned, mapped and forked",
        check_fork,
        "Keep all that the future depends on in State; nothing in the simulator.",
    ),
    CheckItem(
        "state survives the run record",
        check_record,
        "Return plain tensors in State, in the simulator's type; see record_stage.py.",
    ),
    CheckItem(
        "2T steps are T steps twice", check_halves, "Something besides State survives between steps, or is lost at a rollout's end."
    ),
    CheckItem(
        "a batch is a loop over worlds", check_batch, "Worlds mix: look for sums over the first axis and for shared buffers."
    ),
    CheckItem(
        "deterministic where declared", check_determinism, "Order the sums, or take the device out of deterministic_devices."
    ),
    CheckItem("declared tool kinds run", check_kinds, "Implement the kind, or take it out of tool_kinds."),
    CheckItem(
        "capabilities hold",
        check_capabilities,
        "Call Simulator.__init__, which compares with the declared capabilities; correct those.",
    ),
    CheckItem("bad arguments are named", check_errors, "Call Simulator.check_inputs first in rollout; raise InputError in vjp."),
    CheckItem("senseless numbers are refused", check_values_refused, "Call Simulator.check_inputs first in rollout."),
)
