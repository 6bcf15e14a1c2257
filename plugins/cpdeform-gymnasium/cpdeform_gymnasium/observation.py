"""What an agent sees: PlasticineLab's observation of some particles and of all tools."""

from __future__ import annotations

import torch
from torch import Tensor

from cpdeform.core.errors import InputError
from cpdeform.core.scene import Scene
from cpdeform.core.state import State

OBSERVED_PARTICLES = 200
"""Particles that PlasticineLab lets an agent see."""

POSE_NUMBERS = 7
"""Position and unit quaternion wxyz; a tool with a gap has one number more."""


class Observation:
    """Positions and velocities of every k-th particle, particle by particle, then the tools one after the other.

    A tool is seen as its position (3) and its unit quaternion wxyz (4), chopsticks with their gap (1) behind.

    Args:
        scene: The scene.
        particles: Number of particles P that are seen, at most; k is the largest step that gives so many.

    Raises:
        InputError: `particles` is below 1.

    References:
        Huang et al., "PlasticineLab: A Soft-Body Manipulation Benchmark with Differentiable Physics", ICLR 2021.
    """

    def __init__(self, scene: Scene, *, particles: int = OBSERVED_PARTICLES) -> None:
        if particles < 1:
            raise InputError("observed_particles", came=str(particles), expected="at least 1")
        step = max(1, scene.particle_count // particles)
        self.particles = torch.arange(scene.particle_count)[::step][:particles]
        self._pose_numbers = [POSE_NUMBERS + (tool.kind == "Chopsticks") for tool in scene.tools]

    @property
    def size(self) -> int:
        """Number of values O of an observation."""
        return 6 * len(self.particles) + sum(self._pose_numbers)

    def observe(self, state: State) -> Tensor:
        """Observations (B, O) of B worlds; differentiable with respect to the state."""
        index = self.particles.to(state.position.device)
        clay = torch.cat([state.position[:, index], state.velocity[:, index]], dim=-1).flatten(1)
        tools = [state.tool_pose[:, tool, :count] for tool, count in enumerate(self._pose_numbers)]
        return torch.cat([clay, *tools], dim=1)
