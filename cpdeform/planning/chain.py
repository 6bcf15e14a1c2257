"""Several stages as one rollout, so that a later loss can lead the actions of all of them."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import torch
from torch import Tensor

from cpdeform.core.errors import CapabilityError, InputError
from cpdeform.core.final_gradient import takes_final_gradient
from cpdeform.core.simulator import RolloutGradient, Simulator, Trajectory
from cpdeform.core.state import State
from cpdeform.planning.placed import Placing, SimulatorPlaced
from cpdeform.planning.wrapped import SimulatorWrapped


class SimulatorChain(SimulatorWrapped):
    """A simulator whose rollout is a row of stages: between them the tools are lifted off and put to the next stage's poses.

    The clay goes on as the stage before left it. A tool that would begin a stage inside it, since the stages before have changed,
    is first moved out by the shortest way (`cpdeform.planning.stage_start`). The gradient takes that way as fixed, and the poses,
    too, but for what rows of actions at the start of each stage make of them, if `placing` is given.

    Args:
        simulator: Computes the stages; its `vjp` has to take `grad_final_state`.
        poses: Poses (K, M, 8) of all tools at the start of each stage.
        rest_steps: The last environment steps of each stage, whose actions have no gradient.
        placing: Rows of actions before those of each stage that place its tools anew; None for no such rows.

    Raises:
        CapabilityError: The simulator's gradients cannot be chained.
        InputError: There is no stage.
    """

    def __init__(self, simulator: Simulator, *, poses: Tensor, rest_steps: int = 0, placing: Placing | None = None) -> None:
        if not len(poses):
            raise InputError("poses", came="no stage", expected="at least one stage")
        if not takes_final_gradient(simulator):
            raise CapabilityError(
                f"{type(simulator).__name__} cannot polish several stages together: its vjp takes no grad_final_state. "
                "Choose another backend, or add the argument (see Simulator.vjp)."
            )
        super().__init__(simulator)
        self._poses, self._rest_steps = poses.to(simulator.device, simulator.dtype), rest_steps
        self._stage = SimulatorPlaced(simulator, placing)

    def rollout(self, state: State, actions: Tensor) -> Trajectory:
        """All stages, one after the other, with actions (B, K (rows + T), A); where two meet, the tools are those of the later."""
        stages = [state]
        parts: list[Trajectory] = []
        for poses, some in zip(self._poses, self._split(actions), strict=True):
            start = stages[-1].with_tools(poses.expand(state.batch_size, -1, -1))
            parts.append(self._stage.rollout(start, some))
            stages.append(parts[-1].final_state)
        return Trajectory(
            positions=_joined([part.positions for part in parts]),
            tool_poses=_joined([part.tool_poses for part in parts]),
            actions=torch.cat([part.actions for part in parts], dim=1),
            initial_state=state,
            final_state=parts[-1].final_state,
            checkpoints=tuple(parts),
        )

    def vjp(
        self,
        trajectory: Trajectory,
        grad_positions: Tensor,
        grad_tools: Tensor | None = None,
        *,
        grad_final_state: State | None = None,
    ) -> RolloutGradient:
        """Pull gradients back through the stages, the last one first."""
        parts: Sequence[Trajectory] = trajectory.checkpoints
        steps, actions = parts[0].positions.shape[1] - 1, list[Tensor]()
        final = grad_final_state
        for number in reversed(range(len(parts))):
            window = slice(number * steps, (number + 1) * steps + 1)
            slopes = [grad_positions[:, window], None if grad_tools is None else grad_tools[:, window]]
            if number < len(parts) - 1:
                # Where two stages meet, the gradient belongs to the later one's start, and reaches the earlier one through it.
                slopes = [None if slope is None else _without_last(slope) for slope in slopes]
            assert slopes[0] is not None
            found = self._stage.vjp(parts[number], slopes[0], slopes[1], grad_final_state=final)
            found.actions[:, found.actions.shape[1] - self._rest_steps :] = 0.0
            actions.insert(0, found.actions)
            start = found.initial_state
            # The next stage's poses do not depend on where the tools were.
            final = dataclasses.replace(start, tool_pose=torch.zeros_like(start.tool_pose))
        return RolloutGradient(actions=torch.cat(actions, dim=1), initial_state=final if final is not None else start)

    def memory_estimate(self, step_count: int, *, worlds: int | None = None) -> int:
        """Bytes of all stages together; `step_count` is that of the whole row."""
        each = step_count // len(self._poses)
        return len(self._poses) * self._stage.memory_estimate(each, worlds=worlds)

    def _split(self, actions: Tensor) -> tuple[Tensor, ...]:
        if actions.shape[1] % len(self._poses):
            raise InputError(
                "actions", came=f"{actions.shape[1]} environment steps", expected=f"a multiple of the {len(self._poses)} stages"
            )
        return actions.chunk(len(self._poses), dim=1)


def _joined(parts: Sequence[Tensor]) -> Tensor:
    """Tensors (B, T + 1, ...) of stages as one (B, K T + 1, ...); where two meet, that of the later one."""
    return torch.cat([*(part[:, :-1] for part in parts[:-1]), parts[-1]], dim=1)


def _without_last(slope: Tensor) -> Tensor:
    result = slope.clone()
    result[:, -1] = 0.0
    return result
