"""Placements as actions: the gradient that leads a plan also leads the tools' poses where it begins."""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from cpdeform.core.rotation import from_rotation_vector, multiply
from cpdeform.core.scene import Scene
from cpdeform.core.simulator import RolloutGradient, Simulator, Trajectory
from cpdeform.core.state import State
from cpdeform.planning.stage_start import begin_stage
from cpdeform.planning.wrapped import SimulatorWrapped

LENGTH, ANGLE = 0.03, 0.3
"""How far an action of 1 moves a tool's place (length units) and turns it (radians): a few times what an action does to it in a
step, so that the steps of a descent place it in time."""

NUMBERS = 6
"""Numbers that place a tool: a move and a rotation vector."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Placing:
    """Rows of actions, before those of a plan, that place a scene's movable tools anew.

    A row has as many numbers as an action of the scene. Together they hold, tool after tool, a move in `length` and a rotation
    vector in `angle`; numbers that are left over do nothing, and rows of zeros change nothing.

    Attributes:
        scene: The tools.
        length: How far a tool moves by a number of 1, length units.
        angle: How far it turns, radians.
    """

    scene: Scene
    length: float = LENGTH
    angle: float = ANGLE

    @property
    def rows(self) -> int:
        """Number of rows."""
        return -(-NUMBERS * len(self._movable) // self.scene.action_size) if self._movable else 0

    def before(self, actions: Tensor) -> Tensor:
        """Actions (..., T, A) with rows of zeros before them, (..., rows + T, A)."""
        return torch.nn.functional.pad(actions, (0, 0, self.rows, 0))

    def split(self, actions: Tensor) -> tuple[Tensor, Tensor]:
        """Rows (..., rows, A) and the plan (..., T, A) after them."""
        return actions[..., : self.rows, :], actions[..., self.rows :, :]

    def placed(self, poses: Tensor, rows: Tensor) -> Tensor:
        """Poses (B, M, 8) changed by rows (B, rows, A); tools stay within their bounds. Differentiable in both."""
        movable = self._movable
        numbers = rows.flatten(1)[:, : NUMBERS * len(movable)].reshape(len(rows), -1, NUMBERS)
        tools = [self.scene.tools[index] for index in movable]
        lower, upper = (poses.new_tensor([getattr(tool, name) for tool in tools]) for name in ("lower_bound", "upper_bound"))
        old = poses[:, movable]
        place = torch.minimum(torch.maximum(old[..., :3] + self.length * numbers[..., :3], lower), upper)
        turned = multiply(from_rotation_vector(self.angle * numbers[..., 3:]), old[..., 3:7])
        new = torch.cat([place, turned, old[..., 7:]], dim=-1)
        return poses.index_copy(1, torch.tensor(movable, device=poses.device), new)

    def executed(self, poses: Tensor, rows: Tensor, begun: Tensor) -> Tensor:
        """Rows (B, rows, A) that place the tools where they began, poses `begun` (B, M, 8), as some were moved out of the clay."""
        movable = self._movable
        count = NUMBERS * len(movable)
        numbers = rows.flatten(1)[:, :count].reshape(len(rows), -1, NUMBERS)
        moved = (begun != self.placed(poses, rows))[:, movable, :3].any(dim=-1, keepdim=True)
        place = (begun[:, movable, :3] - poses[:, movable, :3]) / self.length
        found = torch.cat([torch.where(moved & place.isfinite(), place, numbers[..., :3]), numbers[..., 3:]], dim=-1)
        return torch.cat([found.flatten(1), rows.flatten(1)[:, count:]], dim=1).reshape(rows.shape)

    def pulled_back(self, poses: Tensor, rows: Tensor, slope: Tensor) -> tuple[Tensor, Tensor]:
        """Gradients with respect to poses (B, M, 8) and rows (B, rows, A) of what has gradient `slope` in the placed poses."""
        with torch.enable_grad():
            inputs = (poses.detach().requires_grad_(), rows.detach().requires_grad_())
            found = torch.autograd.grad(self.placed(*inputs), inputs, grad_outputs=slope)
        return found[0], found[1]

    @property
    def _movable(self) -> list[int]:
        return [index for index, tool in enumerate(self.scene.tools) if tool.movable]


class SimulatorPlaced(SimulatorWrapped):
    """A simulator whose first rows of actions place the tools; it takes no time, and the clay stays as it is.

    A tool that would then be inside the clay is moved out of it (`cpdeform.planning.stage_start`), and the rows that the trajectory
    tells are those that place it there: a descent that goes on from them walks along the clay's surface. Were it to go on from the
    rows asked for, the tool would sink deeper with each step, to where the way out leads now to one side, now to another. The
    trajectory begins where the tools are placed: it has T steps for rows + T actions.

    Args:
        simulator: Computes the rollouts.
        placing: What the rows mean; None for no rows.
    """

    def __init__(self, simulator: Simulator, placing: Placing | None) -> None:
        super().__init__(simulator)
        self._placing = placing

    @property
    def rows(self) -> int:
        """Actions before those of the plan."""
        return self._placing.rows if self._placing is not None else 0

    def rollout(self, state: State, actions: Tensor) -> Trajectory:
        """Place the tools by the first rows of actions (B, rows + T, A), then follow the others."""
        rows, plan = actions[:, : self.rows], actions[:, self.rows :]
        poses = state.tool_pose if self._placing is None else self._placing.placed(state.tool_pose, rows.to(state.tool_pose))
        start = begin_stage(self.scene, state, poses, plan)
        inner = self._simulator.rollout(start, plan)
        if self._placing is not None:
            rows = self._placing.executed(state.tool_pose, rows.detach().to(state.tool_pose), start.tool_pose)
        executed = torch.cat([rows.to(inner.actions), inner.actions], dim=1)
        return dataclasses.replace(inner, actions=executed, initial_state=state.clone(), checkpoints=inner)

    def vjp(
        self,
        trajectory: Trajectory,
        grad_positions: Tensor,
        grad_tools: Tensor | None = None,
        *,
        grad_final_state: State | None = None,
    ) -> RolloutGradient:
        """Pull gradients back through the rollout, and on to the rows."""
        # Backends of before `grad_final_state` serve as long as nobody asks for it.
        further = {} if grad_final_state is None else {"grad_final_state": grad_final_state}
        found = self._simulator.vjp(trajectory.checkpoints, grad_positions, grad_tools, **further)
        if self._placing is None:
            return found
        rows, poses = trajectory.actions[:, : self.rows].to(found.actions), trajectory.initial_state.tool_pose
        slope, row_slope = self._placing.pulled_back(poses, rows.to(poses), found.initial_state.tool_pose)
        state = dataclasses.replace(found.initial_state, tool_pose=slope)
        return RolloutGradient(actions=torch.cat([row_slope.to(found.actions), found.actions], dim=1), initial_state=state)

    def memory_estimate(self, step_count: int, *, worlds: int | None = None) -> int:
        """Bytes of a rollout of rows and T steps, `step_count` of them together."""
        return self._simulator.memory_estimate(max(1, step_count - self.rows), worlds=worlds)
