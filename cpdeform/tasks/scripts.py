"""Goals made by scripted tool motions through a simulator.

A motion starts from the scene's own particles, so a goal's particles are the body's, moved.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from cpdeform.core.scene import Scene, Vector3
from cpdeform.core.simulator import Simulator
from cpdeform.core.state import State


@dataclasses.dataclass(frozen=True)
class Leg:
    """A piece of a scripted motion.

    Attributes:
        steps: Environment steps.
        actions: Action of each tool that moves, by its index, in [-1, 1], held during the steps.
        start: Positions that tools are put at before, by index, length units; the others stay where they are.
    """

    steps: int
    actions: Mapping[int, Sequence[float]] = dataclasses.field(default_factory=dict)
    start: Mapping[int, Vector3] = dataclasses.field(default_factory=dict)

    def action_rows(self, scene: Scene) -> torch.Tensor:
        """Actions (T, A) of all tools; components that are not given are zero."""
        row: list[float] = []
        for index, tool in enumerate(scene.tools):
            given = list(self.actions.get(index, ()))
            row += given + [0.0] * (tool.action_size - len(given))
        return torch.tensor(row, dtype=torch.float64).expand(self.steps, -1)


def perform(legs: Sequence[Leg], simulator: Simulator) -> NDArray[np.float64]:
    """Where the particles are after a scripted motion.

    Args:
        legs: The motion.
        simulator: A simulator of the scene; in float64 the result is the same on every machine, but for rounding.

    Returns:
        Particle positions (N, 3), length units.
    """
    return np.asarray(perform_state(legs, simulator).position[0].double().cpu().numpy())


def perform_state(legs: Sequence[Leg], simulator: Simulator) -> State:
    """The state, a single world, after a scripted motion; arguments as for `perform`."""
    state = simulator.initial_state(batch_size=1)
    for leg in legs:
        state = simulator.rollout(_placed(state, leg), leg.action_rows(simulator.scene).unsqueeze(0)).final_state
    return state


def _placed(state: State, leg: Leg) -> State:
    """The state with the leg's tools at their starts."""
    if not leg.start:
        return state
    poses = state.tool_pose.clone()
    for index, position in leg.start.items():
        poses[0, index, :3] = torch.tensor(position, dtype=poses.dtype)
    return state.with_tools(poses)
