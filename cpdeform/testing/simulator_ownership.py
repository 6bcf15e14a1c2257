"""Checks that a trajectory is its own: whatever the caller writes to, the gradient is that of what was rolled out."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import torch
from torch import Tensor

from cpdeform.core.simulator import RolloutGradient, Trajectory
from cpdeform.core.state import State
from cpdeform.testing.report import CheckItem, Finding, worst
from cpdeform.testing.simulator_bench import SimulatorBench, largest_difference, noise_like, random_actions, stirred


def _turn_state(state: State) -> None:
    """Write to every tensor of a state. Particles change places, so that grids that were kept still hold them."""
    for field in dataclasses.fields(State):
        tensor = getattr(state, field.name)
        tensor.copy_(tensor.flip(1) + (0.01 if field.name == "tool_pose" else 0.0))


def _turn(tensor: Tensor) -> None:
    tensor.copy_(0.5 * tensor.flip(1))


WRITES: dict[str, Callable[[State, Tensor, Trajectory], None]] = {
    "the given state": lambda state, actions, trajectory: _turn_state(state),
    "the given actions": lambda state, actions, trajectory: _turn(actions),
    "Trajectory.positions": lambda state, actions, trajectory: _turn(trajectory.positions),
    "Trajectory.tool_poses": lambda state, actions, trajectory: _turn(trajectory.tool_poses),
    "Trajectory.actions": lambda state, actions, trajectory: _turn(trajectory.actions),
    "Trajectory.initial_state": lambda state, actions, trajectory: _turn_state(trajectory.initial_state),
    "Trajectory.final_state": lambda state, actions, trajectory: _turn_state(trajectory.final_state),
}
"""Tensors that the caller has in hand between rollout and vjp."""


def check_gradient_after_writes(bench: SimulatorBench) -> Finding:
    """The gradient does not change when the caller writes to what it gave or got, relative to the gradient's length."""
    bench.require_gradient()
    simulator = bench.make(bench.scene)
    figures: dict[str, float] = {}
    expected: RolloutGradient | None = None
    for name, write in {"nothing": lambda state, actions, trajectory: None, **WRITES}.items():
        state, actions = stirred(simulator).clone(), random_actions(simulator)
        trajectory = simulator.rollout(state, actions)
        weights = noise_like(trajectory.positions, torch.Generator().manual_seed(4))
        write(state, actions, trajectory)
        found = simulator.vjp(trajectory, weights)
        expected = expected or found
        figures[f"after writing to {name}"] = _difference(found, expected)
    return worst(figures, bench.bound(1e-7, 1e-3))


def _difference(found: RolloutGradient, expected: RolloutGradient) -> float:
    pairs = {"actions": (found.actions, expected.actions), **_pairs(found.initial_state, expected.initial_state)}
    return max(largest_difference(first, second) / (float(second.double().norm()) + 1e-9) for first, second in pairs.values())


def _pairs(first: State, second: State) -> dict[str, tuple[Tensor, Tensor]]:
    return {field.name: (getattr(first, field.name), getattr(second, field.name)) for field in dataclasses.fields(State)}


def check_trajectory_after_writes(bench: SimulatorBench) -> Finding:
    """The trajectory does not change when the caller writes to what it gave."""
    simulator = bench.make(bench.scene)
    state, actions = stirred(simulator).clone(), random_actions(simulator)
    trajectory = simulator.rollout(state, actions)
    expected = dataclasses.replace(
        trajectory,
        positions=trajectory.positions.clone(),
        actions=trajectory.actions.clone(),
        initial_state=trajectory.initial_state.clone(),
        final_state=trajectory.final_state.clone(),
    )
    _turn_state(state)
    _turn(actions)
    figures = {
        f"Trajectory.{name}": largest_difference(getattr(trajectory, name), getattr(expected, name))
        for name in ("positions", "actions")
    }
    for name in ("initial_state", "final_state"):
        pairs = _pairs(getattr(trajectory, name), getattr(expected, name))
        figures |= {f"Trajectory.{name}.{field}": largest_difference(*pair) for field, pair in pairs.items()}
    return worst(figures, 0.0)


OWNERSHIP_CHECKS: tuple[CheckItem[SimulatorBench], ...] = (
    CheckItem(
        "a trajectory is a copy of what was given",
        check_trajectory_after_writes,
        "Copy state and actions in rollout, also where their device and type are right already.",
    ),
    CheckItem(
        "gradient is that of what was rolled out",
        check_gradient_after_writes,
        "Let checkpoints hold copies of what vjp reads: neither the caller's tensors nor those of the trajectory.",
    ),
)
