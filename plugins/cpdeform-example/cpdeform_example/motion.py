"""How actions move the rigid tools, and the velocities of their points."""

from __future__ import annotations

import torch
from torch import Tensor

from cpdeform.core.rotation import from_rotation_vector, multiply, rotate
from cpdeform.core.scene import Scene, Tool, ToolChopsticks, ToolRollingPin

ROLLING_RADIUS = 0.03
"""How far a rolling pin rolls a radian, length units; not its radius (PlasticineLab's quirk)."""

SMALLEST_GAP = 0.06
"""What actions never close chopsticks below, length units."""


def move_tools(scene: Scene, poses: Tensor, action: Tensor) -> Tensor:
    """Move all tools for one substep.

    Args:
        scene: Whose tools they are.
        poses: Poses (B, M, 8) before, see `State.tool_pose`.
        action: One environment step's action (B, A) in [-1, 1].

    Returns:
        Poses (B, M, 8) after.
    """
    moved, first = [], 0
    for index, tool in enumerate(scene.tools):
        size = tool.action_size
        scale = action.new_tensor(tool.action_scale) / scene.substeps
        moved.append(_move(tool, poses[:, index], action[:, first : first + size] * scale))
        first += size
    return torch.stack(moved, dim=1) if moved else poses


def _move(tool: Tool, pose: Tensor, motion: Tensor) -> Tensor:
    """Move one tool (B, 8) by a substep's motion (B, `action_size`): length units and radians."""
    if tool.action_size == 0:
        return pose
    position, rotation, gap = pose[:, :3], pose[:, 3:7], pose[:, 7:]
    displacement = motion[:, :3]
    if isinstance(tool, ToolRollingPin):
        displacement, rotation = _roll(rotation, motion)
    elif isinstance(tool, ToolChopsticks):
        rotation = multiply(rotation, from_rotation_vector(motion[:, 3:6]))
        gap = (gap - motion[:, 6:]).clamp(min=SMALLEST_GAP)
    elif tool.action_size >= 6:
        rotation = multiply(from_rotation_vector(motion[:, 3:6]), rotation)
    lower, upper = pose.new_tensor(tool.lower_bound), pose.new_tensor(tool.upper_bound)
    return torch.cat([(position + displacement).clamp(lower, upper), rotation, gap], dim=-1)


def _roll(rotation: Tensor, motion: Tensor) -> tuple[Tensor, Tensor]:
    """Displacement (B, 3) and new rotation (B, 4) of a rolling pin whose motion (B, 3) is roll, turn, lift."""
    roll, turn, lift = motion.unbind(-1)
    axis = rotate(rotation, motion.new_tensor([0.0, -1.0, 0.0]))
    displacement = torch.stack([ROLLING_RADIUS * roll * axis[:, 2], lift, -ROLLING_RADIUS * roll * axis[:, 0]], dim=-1)
    zero = torch.zeros_like(roll)
    about_itself = from_rotation_vector(torch.stack([zero, roll, zero], dim=-1))
    about_vertical = from_rotation_vector(torch.stack([zero, -turn, zero], dim=-1))
    return displacement, multiply(about_vertical, multiply(rotation, about_itself))


def surface_velocity(local: Tensor, before: Tensor, after: Tensor, time_step: float) -> Tensor:
    """Velocity (K, 3) of a tool's points (K, 3), given in its frame, between the poses (K, 8) before and after a substep."""
    turn = rotate(after[:, 3:7], local) - rotate(before[:, 3:7], local)
    return (after[:, :3] - before[:, :3] + turn) / time_step
