"""The objective interface: a scalar per world of a trajectory, and its gradient."""

from __future__ import annotations

import abc
import dataclasses
from collections.abc import Sequence

import torch
from torch import Tensor

from cpdeform.core.simulator import Trajectory


@dataclasses.dataclass(frozen=True)
class ObjectiveResult:
    """Loss and gradient of a batch of trajectories.

    Attributes:
        loss: Loss (B,) of each world.
        grad_positions: Gradient (B, T+1, N, 3) of the sum of the losses with respect to `Trajectory.positions`.
        grad_tools: Gradient (B, T+1, M, 8) with respect to `Trajectory.tool_poses`; None for zero.
        warm: What the objective can start from in the next evaluation of each world, B entries, opaque; None for nothing.
    """

    loss: Tensor
    grad_positions: Tensor
    grad_tools: Tensor | None = None
    warm: tuple[object, ...] | None = None


class Objective(abc.ABC):
    """A loss on trajectories; each world is independent of the others, and nothing is kept between calls."""

    @abc.abstractmethod
    def evaluate(self, trajectory: Trajectory, warm: Sequence[object] | None = None) -> ObjectiveResult:
        """Loss and gradient of each world of a trajectory.

        Args:
            trajectory: B worlds.
            warm: Entries of `ObjectiveResult.warm` of nearby trajectories, one for each world, to start from; None evaluates from
                scratch. It may speed up the evaluation, and changes its result within the objective's accuracy only.
        """

    def losses(self, trajectory: Trajectory, warm: Sequence[object] | None = None) -> Tensor:
        """Loss (B,) of each world without its gradient; defaults to `evaluate`, for an objective that has no quicker way.

        Args:
            trajectory: B worlds.
            warm: As for `evaluate`.
        """
        return self.evaluate(trajectory, warm).loss


class ObjectiveAutograd(Objective):
    """An objective written as a differentiable torch function; its gradient comes from autograd."""

    @abc.abstractmethod
    def loss(self, positions: Tensor, tool_poses: Tensor) -> Tensor:
        """Loss (B,) of positions (B, T+1, N, 3), length units, and tool poses (B, T+1, M, 8)."""

    def losses(self, trajectory: Trajectory, warm: Sequence[object] | None = None) -> Tensor:
        """Loss (B,) alone."""
        with torch.no_grad():
            return self.loss(trajectory.positions.detach(), trajectory.tool_poses.detach())

    def evaluate(self, trajectory: Trajectory, warm: Sequence[object] | None = None) -> ObjectiveResult:
        """Loss and gradient by automatic differentiation of `loss`."""
        positions = trajectory.positions.detach().requires_grad_()
        poses = trajectory.tool_poses.detach().requires_grad_()
        with torch.enable_grad():
            loss = self.loss(positions, poses)
            gradients = torch.autograd.grad(loss.sum(), [positions, poses], allow_unused=True)
        grad_positions = gradients[0] if gradients[0] is not None else torch.zeros_like(positions)
        return ObjectiveResult(loss=loss.detach(), grad_positions=grad_positions, grad_tools=gradients[1])
