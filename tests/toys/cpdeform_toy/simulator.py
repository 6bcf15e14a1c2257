"""A simulator without physics: the tool carries the whole body along, the better the closer it is."""

from __future__ import annotations

import dataclasses
import time

import torch
from torch import Tensor

from cpdeform.core.simulator import RolloutGradient, Simulator, SimulatorCapabilities, Trajectory
from cpdeform.core.state import State


class SimulatorToy(Simulator):
    """All tools and particles are shifted by the actions; particles by a gain that falls with the first tool's distance in x.

    Args:
        break_above: A world with an action component above this becomes nan.
        delay: Seconds that a rollout takes.
    """

    capabilities = SimulatorCapabilities(
        differentiable=True,
        devices=("cpu",),
        dtypes=(torch.float64, torch.float32),
        tool_kinds=("Sphere", "Capsule", "Box", "Cylinder", "Torus", "Mesh"),
        deterministic_devices=("cpu",),
    )

    def __init__(self, scene, *, break_above: float = 2.0, delay: float = 0.0, **options) -> None:
        super().__init__(scene, **options)
        self.break_above = break_above
        self.delay = delay
        self.largest_batch = 0

    def gain(self, state: State) -> Tensor:
        distance = state.tool_pose[:, 0, 0] - state.position[:, :, 0].mean(dim=1)
        return torch.exp(-4.0 * distance**2)

    def rollout(self, state: State, actions: Tensor) -> Trajectory:
        self.check_inputs(state, actions)
        time.sleep(self.delay)
        self.largest_batch = max(self.largest_batch, state.batch_size)
        shift = self._pad(torch.cumsum(actions[..., :3] * self.scale(actions), dim=1))
        body = self.gain(state)[:, None, None] * shift
        positions = state.position[:, None] + body[:, :, None]
        broken = (actions > self.break_above).flatten(1).any(dim=1)
        positions = torch.where(broken[:, None, None, None], torch.nan, positions)
        poses = state.tool_pose[:, None].repeat(1, actions.shape[1] + 1, 1, 1)
        poses[..., :3] += shift[:, :, None]
        final = dataclasses.replace(state, position=positions[:, -1], tool_pose=poses[:, -1])
        return Trajectory(positions, poses, actions, state, final)

    def vjp(self, trajectory, grad_positions, grad_tools=None) -> RolloutGradient:
        grad_shift = self.gain(trajectory.initial_state)[:, None, None] * grad_positions.sum(dim=2)
        if grad_tools is not None:
            grad_shift = grad_shift + grad_tools[..., :3].sum(dim=2)
        later = grad_shift[:, 1:].flip(1).cumsum(1).flip(1)
        actions = torch.zeros_like(trajectory.actions)
        actions[..., :3] = later * self.scale(actions)
        return RolloutGradient(actions, trajectory.initial_state.map(torch.zeros_like))

    def memory_estimate(self, step_count: int, *, worlds: int | None = None) -> int:
        return 8 * (worlds or self.batch_size) * step_count * self.scene.particle_count * 3

    def scale(self, actions: Tensor) -> Tensor:
        return torch.tensor(self.scene.tools[0].action_scale[:3]).to(actions)

    @staticmethod
    def _pad(shift: Tensor) -> Tensor:
        return torch.cat([torch.zeros_like(shift[:, :1]), shift], dim=1)
