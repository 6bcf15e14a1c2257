"""Several stages as one rollout, so that a later loss can lead the actions of all of them."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import ClassVar

import torch
from torch import Tensor

from cpdeform.core.clearance import CLEARANCE, exit_distances, push_out
from cpdeform.core.errors import CapabilityError, InputError
from cpdeform.core.final_gradient import takes_final_gradient
from cpdeform.core.scene import Scene, Tool
from cpdeform.core.shapes.kinds import TOOLS
from cpdeform.core.simulator import RolloutGradient, Simulator, SimulatorCapabilities, Trajectory
from cpdeform.core.state import State

FARTHEST = 0.3
"""How far a tool is moved out of the clay at most, length units."""

TOUCHING = 0.0
"""Distance from the clay below which a tool is moved out of it, length units. It is less than the clearance that a tool was given,
so that a small change of the stages before moves none, and one that was moved out is not moved again."""


class SimulatorChain(Simulator):
    """A simulator whose rollout is a row of stages: between them the tools are lifted off and put to the next stage's poses.

    The clay goes on as the stage before left it. A tool that would begin a stage inside it, since the stages before have changed,
    is first moved out by the shortest way (`moved_out`). The gradient takes that way, and the poses, as fixed numbers.

    Args:
        simulator: Computes the stages; its `vjp` has to take `grad_final_state`.
        poses: Poses (K, M, 8) of all tools at the start of each stage.
        rest_steps: The last environment steps of each stage, whose actions have no gradient.

    Raises:
        CapabilityError: The simulator's gradients cannot be chained.
        InputError: There is no stage.
    """

    capabilities: ClassVar[SimulatorCapabilities] = SimulatorCapabilities(
        differentiable=True,
        devices=("cpu", "cuda"),
        dtypes=(torch.float32, torch.float64),
        tool_kinds=tuple(TOOLS),
        deterministic_devices=(),
    )

    def __init__(self, simulator: Simulator, *, poses: Tensor, rest_steps: int = 0) -> None:
        if not len(poses):
            raise InputError("poses", came="no stage", expected="at least one stage")
        if not takes_final_gradient(simulator):
            raise CapabilityError(
                f"{type(simulator).__name__} cannot polish several stages together: its vjp takes no grad_final_state. "
                "Choose another backend, or add the argument (see Simulator.vjp)."
            )
        super().__init__(simulator.scene, batch_size=simulator.batch_size, device=simulator.device, dtype=simulator.dtype)
        self._simulator, self._poses, self._rest_steps = simulator, poses.to(simulator.device, simulator.dtype), rest_steps

    def rollout(self, state: State, actions: Tensor) -> Trajectory:
        """All stages, one after the other, with actions (B, K T, A); where two meet, the tools are where the later one begins."""
        stages = [state]
        parts: list[Trajectory] = []
        for poses, some in zip(self._poses, self._split(actions), strict=True):
            parts.append(self._simulator.rollout(begin_stage(self.scene, stages[-1], poses, some), some))
            stages.append(parts[-1].final_state)
        return Trajectory(
            positions=_joined([part.positions for part in parts]),
            tool_poses=_joined([part.tool_poses for part in parts]),
            actions=actions.detach().clone(),
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
        steps, actions = parts[0].step_count, list[Tensor]()
        final = grad_final_state
        for number in reversed(range(len(parts))):
            window = slice(number * steps, (number + 1) * steps + 1)
            slopes = [grad_positions[:, window], None if grad_tools is None else grad_tools[:, window]]
            if number < len(parts) - 1:
                # Where two stages meet, the gradient belongs to the later one's start, and reaches the earlier one through it.
                slopes = [None if slope is None else _without_last(slope) for slope in slopes]
            assert slopes[0] is not None
            found = self._simulator.vjp(parts[number], slopes[0], slopes[1], grad_final_state=final)
            found.actions[:, steps - self._rest_steps :] = 0.0
            actions.insert(0, found.actions)
            start = found.initial_state
            # The next stage's poses do not depend on where the tools were.
            final = dataclasses.replace(start, tool_pose=torch.zeros_like(start.tool_pose))
        return RolloutGradient(actions=torch.cat(actions, dim=1), initial_state=final if final is not None else start)

    def memory_estimate(self, step_count: int, *, worlds: int | None = None) -> int:
        """Bytes of all stages together; `step_count` is that of the whole row."""
        each = step_count // len(self._poses)
        return len(self._poses) * self._simulator.memory_estimate(each, worlds=worlds)

    def release_memory(self) -> None:
        """See `Simulator`."""
        self._simulator.release_memory()

    def _split(self, actions: Tensor) -> tuple[Tensor, ...]:
        if actions.shape[1] % len(self._poses):
            raise InputError(
                "actions", came=f"{actions.shape[1]} environment steps", expected=f"a multiple of the {len(self._poses)} stages"
            )
        return actions.chunk(len(self._poses), dim=1)


def begin_stage(scene: Scene, state: State, poses: Tensor, actions: Tensor) -> State:
    """A stage's start: tools at their poses, those that would be inside the clay moved out of it.

    Args:
        scene: The tools.
        state: Clay of B worlds.
        poses: Poses (M, 8), or (B, M, 8) where the worlds differ.
        actions: The stage's actions (B, T, A).
    """
    placed = poses.to(state.position).expand(state.batch_size, -1, -1).clone()
    for world in range(state.batch_size):
        offset = 0
        for index, tool in enumerate(scene.tools):
            if tool.movable:
                motion = actions[world, 0, offset : offset + tool.action_size][:3] * actions.new_tensor(tool.action_scale[:3])
                placed[world, index] = moved_out(tool, placed[world, index], motion, state.position[world])
            offset += tool.action_size
    return state.with_tools(placed)


def moved_out(tool: Tool, pose: Tensor, motion: Tensor, particles: Tensor) -> Tensor:
    """A tool's pose (8,), moved out of the clay by the shortest of three ways: against its motion, upwards, or off its surface.

    Most often a tool touches by a hair, as the stages before have changed a little: then it goes as little off the surface. By the
    other two ways alone one beside a wall would be lifted over it, and the loss would leap.

    Args:
        tool: The tool.
        pose: Pose (8,).
        motion: Where the tool goes first (up to 3 numbers), length units.
        particles: The clay (N, 3), length units.

    Returns:
        The pose; unchanged where the tool is free already, or where there is no way out within `FARTHEST` and its bounds.
    """
    back = torch.nn.functional.pad(-motion.detach(), (0, 3 - len(motion)))
    up = back.new_tensor([0.0, 1.0, 0.0])
    length = float(torch.linalg.vector_norm(back))
    # A tool that begins to rise would go back through the floor.
    directions = [back / length, up] if length > 0.0 and float(back[1]) >= 0.0 else [up]
    lower, upper = pose.new_tensor(tool.lower_bound), pose.new_tensor(tool.upper_bound)
    way = {"reach": FARTHEST, "clearance": CLEARANCE, "least_depth": -TOUCHING}
    places = [
        pose[:3] + exit_distances(tool, pose[3:7], pose[None, :3], direction, particles, **way)[0] * direction
        for direction in directions
    ]
    places.append(push_out(tool, pose, particles, clearance=CLEARANCE, touching=TOUCHING))
    found, shortest = pose, math.inf
    for place in places:
        gone = float(torch.linalg.vector_norm(place - pose[:3]))
        if gone < shortest and bool(((place >= lower) & (place <= upper)).all()):
            found, shortest = torch.cat([place, pose[3:]]), gone
    return found


def _joined(parts: Sequence[Tensor]) -> Tensor:
    """Tensors (B, T + 1, ...) of stages as one (B, K T + 1, ...); where two meet, that of the later one."""
    return torch.cat([*(part[:, :-1] for part in parts[:-1]), parts[-1]], dim=1)


def _without_last(slope: Tensor) -> Tensor:
    result = slope.clone()
    result[:, -1] = 0.0
    return result
