"""Checks of gradients with respect to the final state, with which rollouts are chained."""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from cpdeform.core.scene import Scene
from cpdeform.core.simulator import RolloutGradient, Trajectory, differentiable_rollout
from cpdeform.core.state import State
from cpdeform.testing.report import CheckItem, Finding, Skip, worst
from cpdeform.testing.simulator_bench import SimulatorBench, largest_difference, noise_like, random_actions, stirred
from cpdeform.testing.simulator_gradient import DOUBLE_BOUND, Probe

INPUTS = {
    "position": "velocity",
    "velocity": "velocity",
    "affine": "velocity",
    "elastic_strain": "elastic_strain",
    "tool_pose": "actions",
}
"""Tensors of the final state, and the input by which its gradient is compared with central differences; the chain compares all."""

SIZES = {"position": 1.0, "velocity": 1e-2, "affine": 1e-3, "elastic_strain": 1.0, "tool_pose": 1.0}
"""Weights of the final state's tensors, so that each counts in their sum."""


class _FinalProbe(Probe):
    """As `Probe`, with a loss on one tensor of the final state."""

    steps = 1

    def __init__(self, bench: SimulatorBench, scene: Scene, field: str) -> None:
        self.field = field
        super().__init__(bench, scene)

    def outputs(self, trajectory: Trajectory) -> tuple[Tensor, ...]:
        """The tensor."""
        return (getattr(trajectory.final_state, self.field),)

    def pull_back(self, trajectory: Trajectory) -> RolloutGradient:
        """Gradient of the loss."""
        final = trajectory.final_state.map(torch.zeros_like)
        final = dataclasses.replace(final, **{self.field: self.weights[0]})
        return self.simulator.vjp(trajectory, torch.zeros_like(trajectory.positions), grad_final_state=final)


def check_final_gradients(bench: SimulatorBench) -> Finding:
    """Gradients of every tensor of the final state."""
    bench.require_gradient()
    if not bench.double:
        raise Skip("differences of final velocities are too coarse in single precision; the check of chained rollouts tells")
    figures = {}
    for field, name in INPUTS.items():
        if name != "actions" or bench.scene.action_size:
            figures[f"final {field} by {name}"] = _FinalProbe(bench, bench.scene, field).error(name)
    return worst(figures, DOUBLE_BOUND)


def check_chain(bench: SimulatorBench) -> Finding:
    """A rollout of 2T steps has the values and gradients of two of T steps, the second from the final state of the first."""
    bench.require_gradient()
    simulator = bench.make(bench.scene, batch_size=2)
    start, plan = stirred(simulator, batch_size=2), random_actions(simulator, batch_size=2, steps=2)
    names = [field.name for field in dataclasses.fields(State)]
    results = []
    for lengths in ((2,), (1, 1)):
        state = start.map(lambda tensor: tensor.detach().clone().requires_grad_())
        inputs = {"actions": plan.clone().requires_grad_(), **{name: getattr(state, name) for name in names}}
        parts = []
        for actions in inputs["actions"].split(lengths, dim=1):
            parts.append(differentiable_rollout(simulator, state, actions))
            state = parts[-1].final_state
        outputs = {
            "positions": torch.cat([parts[0].positions, *(part.positions[:, 1:] for part in parts[1:])], dim=1),
            "tool_poses": torch.cat([part.tool_poses[:, 1:] for part in parts], dim=1),
            **{name: SIZES[name] * getattr(state, name) for name in names},
        }
        generator = torch.Generator().manual_seed(6)
        loss = sum((output * noise_like(output.detach(), generator)).sum() for output in outputs.values())
        gradients = torch.autograd.grad(loss, list(inputs.values()), allow_unused=True, materialize_grads=True)
        values = {name: output.detach() for name, output in outputs.items()}
        results.append((values, dict(zip(inputs, gradients, strict=True))))
    (expected, whole), (found, chained) = results
    figures = {f"value of {name}": largest_difference(found[name], value) for name, value in expected.items()}
    for name, gradient in whole.items():
        figures[f"gradient of {name}"] = largest_difference(chained[name], gradient) / (float(gradient.double().norm()) + 1e-9)
    return worst(figures, bench.bound(1e-7, 1e-3))


CHAIN_CHECKS: tuple[CheckItem[SimulatorBench], ...] = (
    CheckItem(
        "gradient of the final state",
        check_final_gradients,
        "Take grad_final_state in vjp: the way back starts from it instead of from zero.",
    ),
    CheckItem(
        "gradient of 2T steps is that of T steps twice",
        check_chain,
        "Compare grad_final_state, which comes in, with RolloutGradient.initial_state, which goes out: one convention for both.",
    ),
)
