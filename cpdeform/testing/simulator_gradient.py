"""Checks of a simulator's vector-Jacobian product against central differences."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable

import torch
from torch import Tensor

from cpdeform.core.errors import CapabilityError
from cpdeform.core.scene import Scene
from cpdeform.core.simulator import RolloutGradient, Simulator, Trajectory
from cpdeform.core.state import State
from cpdeform.testing.report import CheckItem, Finding, Skip, complaint_unless_raised, violations, worst
from cpdeform.testing.simulator_bench import (
    SimulatorBench,
    example_tool,
    largest_difference,
    no_actions,
    noise_like,
    random_actions,
    resting,
    stirred,
)

STEPS = {
    "actions": (1e-6, 2e-3),
    "position": (1e-8, 1e-5),
    "velocity": (1e-6, 1e-2),
    "affine": (1e-5, 1e-1),
    "elastic_strain": (1e-8, 1e-4),
    "tool_pose": (1e-8, 1e-5),
}
"""Step of the differences in double and single precision, in the unit of each input."""

DOUBLE_BOUND, SINGLE_BOUND = 2e-4, 0.5
"""Largest error of a slope, in units of the slope that a random direction typically has. That along the gradient is sqrt(n) times
as large for n numbers, so that the wide bound of single precision still sees a gradient that is too long by a percent or so."""


class Probe:
    """A rollout of two worlds, a random linear loss on it, and the gradient that the simulator finds."""

    steps = 2

    def __init__(self, bench: SimulatorBench, scene: Scene) -> None:
        self.bench = bench
        self.simulator: Simulator = bench.make(scene, batch_size=2)
        self.state, self.actions = (
            stirred(self.simulator, batch_size=2),
            random_actions(self.simulator, batch_size=2, steps=self.steps),
        )
        trajectory = self.simulator.rollout(self.state, self.actions)
        self.generator = torch.Generator().manual_seed(2)
        self.base = tuple(output.double() for output in self.outputs(trajectory))
        self.weights = tuple(noise_like(output, self.generator) for output in self.outputs(trajectory))
        self.gradient = self.pull_back(trajectory)

    def outputs(self, trajectory: Trajectory) -> tuple[Tensor, ...]:
        """What the loss is about."""
        return trajectory.positions, trajectory.tool_poses

    def pull_back(self, trajectory: Trajectory) -> RolloutGradient:
        """Gradient of the loss."""
        return self.simulator.vjp(trajectory, *self.weights)

    def loss(self, state: State, actions: Tensor) -> float:
        """The linear loss, relative to that of the unchanged rollout."""
        result = self.simulator.rollout(state, actions)
        return sum(
            float(((now.double() - before) * weight.double()).sum())
            for now, before, weight in zip(self.outputs(result), self.base, self.weights, strict=True)
        )

    def error(self, name: str) -> float:
        """Largest error of the slope along a random direction and along the gradient itself."""
        value = self.actions if name == "actions" else getattr(self.state, name)
        found = self.gradient.actions if name == "actions" else getattr(self.gradient.initial_state, name)
        if found.shape != value.shape:
            return math.inf
        if not value.numel():
            return 0.0
        random = self._allowed(name, noise_like(value, self.generator))
        along = self._allowed(name, found / found.norm().clamp_min(1e-300) * math.sqrt(value.numel()))
        return max(self._slope_error(name, value, found, direction) for direction in (random, along))

    def _allowed(self, name: str, direction: Tensor) -> Tensor:
        """Remove what no backend is asked for: a change of a quaternion's length, and of a gap that a tool does not have."""
        if name != "tool_pose":
            return direction
        direction = direction.clone()
        rotation = self.state.tool_pose[..., 3:7]
        direction[..., 3:7] -= (direction[..., 3:7] * rotation).sum(dim=-1, keepdim=True) * rotation
        for index, tool in enumerate(self.simulator.scene.tools):
            if tool.kind != "Chopsticks":  # type: ignore[comparison-overlap,unused-ignore]  # older scenes have no such tool
                direction[:, index, 7] = 0.0
        return direction

    def _slope_error(self, name: str, value: Tensor, found: Tensor, direction: Tensor) -> float:
        step = STEPS[name][0 if self.bench.double else 1]
        losses = []
        for sign in (1.0, -1.0):
            changed = value + sign * step * direction
            if name == "actions":
                losses.append(self.loss(self.state, changed))
            else:
                losses.append(self.loss(dataclasses.replace(self.state, **{name: changed}), self.actions))
        slope = (losses[0] - losses[1]) / (2.0 * step)
        size = float(direction.double().norm())
        scale = max(float(found.double().norm()), abs(slope) / max(size, 1e-300)) * size / math.sqrt(value.numel())
        error = abs(float((found.double() * direction.double()).sum()) - slope)
        return error / (scale + 1e-9) if math.isfinite(error) else math.nan


def check_gradient(bench: SimulatorBench, *, name: str) -> Finding:
    """Gradient of one input of a rollout."""
    bench.require_gradient()
    if name in ("actions", "tool_pose") and not bench.scene.action_size:
        raise Skip("The scene has no tool that moves.")
    return Finding(Probe(bench, bench.scene).error(name), bench.bound(DOUBLE_BOUND, SINGLE_BOUND))


def check_kind_gradients(bench: SimulatorBench) -> Finding:
    """Gradients through the contact with every declared kind of tool."""
    bench.require_gradient()
    figures = {}
    for kind in bench.capabilities.tool_kinds:
        probe = Probe(bench, resting(example_tool(kind)))
        for name in ("actions", "tool_pose", "position"):
            figures[f"{name} with {kind}"] = probe.error(name)
    if not figures:
        raise Skip("It declares no kind of tool.")
    return worst(figures, bench.bound(DOUBLE_BOUND, SINGLE_BOUND))


def check_batch_gradients(bench: SimulatorBench) -> Finding:
    """Gradients of the worlds of a batch know nothing of each other."""
    bench.require_gradient()
    simulator = bench.make(bench.scene, batch_size=2)
    state, actions = stirred(simulator, batch_size=2), random_actions(simulator, batch_size=2)
    together = simulator.rollout(state, actions)
    grad = noise_like(together.positions, torch.Generator().manual_seed(3))
    gradient = simulator.vjp(together, grad)
    figures = {}
    for world in range(2):
        alone = simulator.vjp(simulator.rollout(state.select(world), actions[world : world + 1]), grad[world : world + 1])
        pairs = {
            "actions": (alone.actions[0], gradient.actions[world]),
            "position": (alone.initial_state.position[0], gradient.initial_state.position[world]),
        }
        for name, (first, second) in pairs.items():
            scale = float(first.double().norm()) + 1e-9
            figures[f"{name} of world {world}"] = largest_difference(first, second) / scale
    return worst(figures, bench.bound(1e-7, 1e-3))


def check_gradients_from_rest(bench: SimulatorBench) -> Finding:
    """Gradients are finite where nothing moves: no velocity, no strain, no action; with and without touching."""
    bench.require_gradient()
    complaints = []
    kinds = bench.capabilities.tool_kinds
    for kind in kinds:
        for height in (None, 0.45):
            tool = example_tool(kind)
            x, y, z = tool["position"]
            scene = resting({**tool, "position": (x, y if height is None else height, z)}, gravity_parameter=(0.0, 0.0, 0.0))
            simulator = bench.make(scene)
            trajectory = simulator.rollout(simulator.initial_state(), no_actions(simulator))
            gradient = simulator.vjp(trajectory, torch.ones_like(trajectory.positions), torch.ones_like(trajectory.tool_poses))
            complaints += [f"{name}: {kind}" for name in _not_finite(gradient)]
    if not kinds:
        raise Skip("It declares no kind of tool.")
    return violations(complaints)


def _not_finite(gradient: RolloutGradient) -> list[str]:
    tensors = {"actions": gradient.actions}
    tensors |= {field.name: getattr(gradient.initial_state, field.name) for field in dataclasses.fields(State)}
    return [name for name, tensor in tensors.items() if not bool(torch.isfinite(tensor).all())]


def check_gradient_refused(bench: SimulatorBench) -> Finding:
    """A simulator that declares no gradient says so when asked for one."""
    if bench.capabilities.differentiable:
        raise Skip("It declares that it is differentiable.")
    simulator = bench.make(bench.scene)
    trajectory = simulator.rollout(simulator.initial_state(), no_actions(simulator))
    call: Callable[[], object] = lambda: simulator.vjp(trajectory, torch.ones_like(trajectory.positions))  # noqa: E731
    return violations(complaint_unless_raised(call, CapabilityError, words=["differentiable"], what="vjp"))


_DIFFERENCES = (
    "Central differences disagree with vjp. Compare one substep first, then one kernel; a tensor that vjp adds to twice, "
    "or a branch that it forgets, shows there."
)

GRADIENT_CHECKS: tuple[CheckItem[SimulatorBench], ...] = (
    *(CheckItem(f"gradient of {name}", functools.partial(check_gradient, name=name), _DIFFERENCES) for name in STEPS),
    CheckItem("gradient with each tool kind", check_kind_gradients, _DIFFERENCES),
    CheckItem("gradient of a batch is a loop over worlds", check_batch_gradients, "Worlds mix on the way back."),
    CheckItem(
        "gradient is finite from rest",
        check_gradients_from_rest,
        "A length or rotation vector of zero, or equal singular values, divides by zero; take the limit there.",
    ),
    CheckItem("gradient is refused where not declared", check_gradient_refused, "Raise CapabilityError in vjp."),
)
