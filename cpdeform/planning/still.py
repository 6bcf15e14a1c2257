"""Trajectories in which nothing happens."""

from __future__ import annotations

import torch

from cpdeform.core.scene import Scene
from cpdeform.core.simulator import Trajectory
from cpdeform.core.state import State


def still_trajectory(state: State, step_count: int, *, scene: Scene) -> Trajectory:
    """A trajectory of `step_count` steps during which nothing moves, to take the loss of a state.

    Only its last step arrives with the velocity of the state, for an objective that asks whether the clay is at rest.
    """
    worlds = state.batch_size
    positions = state.position.unsqueeze(1).repeat(1, step_count + 1, 1, 1)
    seconds = scene.time_step * scene.substeps
    positions[:, -2] = (state.position - seconds * state.velocity).clamp(0.0, 1.0)
    return Trajectory(
        positions=positions,
        tool_poses=state.tool_pose.unsqueeze(1).expand(-1, step_count + 1, -1, -1),
        actions=torch.zeros(worlds, step_count, scene.action_size, dtype=state.position.dtype, device=state.position.device),
        initial_state=state,
        final_state=state,
    )
