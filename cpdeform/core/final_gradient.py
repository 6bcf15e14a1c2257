"""Gradients with respect to the final state of a rollout: how they come from autograd and reach a backend's `vjp`.

With them rollouts can be chained, step by step: the gradient with respect to the start of one is that with respect to the end of
the one before.
"""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from cpdeform.core.errors import CapabilityError, InputError
from cpdeform.core.state import State

if TYPE_CHECKING:
    from cpdeform.core.simulator import RolloutGradient, Simulator, Trajectory


def state_tensors(state: State) -> tuple[Tensor, ...]:
    """The tensors of a state, in the order of its fields."""
    return tuple(getattr(state, field.name) for field in dataclasses.fields(State))


def check_final_gradient(trajectory: Trajectory, gradient: State | None) -> None:
    """Raise `InputError` unless a gradient has the shapes of a trajectory's final state; for backends to call in `vjp`."""
    if gradient is None:
        return
    for field in dataclasses.fields(State):
        came, expected = (tuple(getattr(state, field.name).shape) for state in (gradient, trajectory.final_state))
        if came != expected:
            raise InputError(f"grad_final_state.{field.name}", came=f"shape {came}", expected=f"shape {expected}")


def add_final_gradient(
    trajectory: Trajectory, grad_positions: Tensor, grad_tools: Tensor | None, position: Tensor | None, pose: Tensor | None
) -> tuple[Tensor, Tensor | None]:
    """Add gradients with respect to the final particles and tools to those with respect to the last step, which is the same place.

    Args:
        trajectory: Its last step is that of the final state.
        grad_positions: Gradient (B, T+1, N, 3); not modified.
        grad_tools: Gradient (B, T+1, M, 8), or None for zero; not modified.
        position: Gradient (B, N, 3) with respect to `final_state.position`, or None for zero.
        pose: Gradient (B, M, 8) with respect to `final_state.tool_pose`, or None for zero.

    Returns:
        The sums, in the shapes of `grad_positions` and `grad_tools`.
    """
    if position is not None:
        grad_positions = grad_positions.clone()
        grad_positions[:, -1] += position.to(grad_positions)
    if pose is not None:
        zero = grad_tools is None
        grad_tools = torch.zeros_like(trajectory.tool_poses) if grad_tools is None else grad_tools
        grad_tools = grad_tools if zero else grad_tools.clone()
        grad_tools[:, -1] += pose.to(grad_tools)
    return grad_positions, grad_tools


def pull_back(
    simulator: Simulator,
    trajectory: Trajectory,
    grad_positions: Tensor | None,
    grad_tools: Tensor | None,
    grad_final: Sequence[Tensor | None],
) -> RolloutGradient:
    """Call a backend's `vjp` with what autograd knows; None stands for zero.

    Gradients of the final positions and tools go with those of the last step, so that a backend whose `vjp` takes no
    `grad_final_state` serves as long as nothing else is asked for.

    Args:
        simulator: Made the trajectory.
        trajectory: The rollout.
        grad_positions: Gradient (B, T+1, N, 3) with respect to the positions.
        grad_tools: Gradient (B, T+1, M, 8) with respect to the tool poses.
        grad_final: Gradients with respect to the final state's tensors, in the order of its fields.

    Raises:
        CapabilityError: The gradient of a final velocity, affine field or strain is asked for, and the backend does not take it.
    """
    if grad_positions is None:
        grad_positions = torch.zeros_like(trajectory.positions)
    position, velocity, affine, strain, pose = grad_final
    if velocity is None and affine is None and strain is None:
        return simulator.vjp(trajectory, *add_final_gradient(trajectory, grad_positions, grad_tools, position, pose))
    if not takes_final_gradient(simulator):
        raise CapabilityError(
            f"{type(simulator).__name__} has no gradient with respect to the final velocity, affine field and strain: its vjp "
            "takes no grad_final_state. Choose another backend, add the argument (see Simulator.vjp), or detach the state that "
            "you go on from: trajectory.final_state.clone()."
        )
    pairs = zip(grad_final, state_tensors(trajectory.final_state), strict=True)
    final = State(*(torch.zeros_like(like) if grad is None else grad for grad, like in pairs))
    return simulator.vjp(trajectory, grad_positions, grad_tools, grad_final_state=final)


def takes_final_gradient(simulator: Simulator) -> bool:
    """Whether a backend's `vjp` has the argument `grad_final_state`; those written before it was there do not."""
    parameters = inspect.signature(simulator.vjp).parameters.values()
    return any(parameter.name == "grad_final_state" or parameter.kind is parameter.VAR_KEYWORD for parameter in parameters)
