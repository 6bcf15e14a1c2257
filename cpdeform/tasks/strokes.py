"""Targets made by scripted tool motions through a simulator.

The motion starts from the scene's own particles, so a target's particles correspond to the body's, one to one.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from types import MappingProxyType

import numpy as np
import torch
from numpy.typing import NDArray

from cpdeform.core.scene import Vector3
from cpdeform.core.simulator import Simulator

POSITION_SCALE = 2**16
"""Target files hold positions as whole multiples of 1/POSITION_SCALE, length units."""


@dataclasses.dataclass(frozen=True)
class Stroke:
    """A scripted motion of a scene's first tool.

    Attributes:
        start: Position of the tool at the start, length units.
        legs: Pairs of a number of steps and the action (x, y, z) in [-1, 1] held during them.
    """

    start: Vector3
    legs: tuple[tuple[int, Vector3], ...]

    def actions(self, action_size: int) -> torch.Tensor:
        """Actions (T, A), zero for all but the first tool's translation."""
        rows = [action for count, action in self.legs for _ in range(count)]
        result = torch.zeros(len(rows), action_size, dtype=torch.float64)
        result[:, :3] = torch.tensor(rows, dtype=torch.float64)
        return result


PEN_HEIGHT = 0.161
"""Height of the pen's centre when its tip is 1/1000 above the board, length units."""

WRITER_STROKES: Mapping[str, Stroke] = MappingProxyType(
    {
        "v1": Stroke((0.40, PEN_HEIGHT, 0.60), ((4, (0.3, -1.0, -0.4)), (6, (0.2, -0.3, -1.0)))),
        "v2": Stroke((0.60, PEN_HEIGHT, 0.60), ((4, (-0.4, -1.0, -0.3)), (6, (-1.0, -0.3, -0.2)))),
        "v3": Stroke((0.50, PEN_HEIGHT, 0.40), ((4, (-0.3, -1.0, 0.0)), (6, (-1.0, -0.3, 0.2)))),
        "v4": Stroke((0.61, PEN_HEIGHT, 0.55), ((4, (-0.2, -1.0, -0.4)), (6, (-0.3, -0.3, -1.0)))),
        "v5": Stroke((0.42, PEN_HEIGHT, 0.60), ((5, (0.2, -1.0, -0.2)), (5, (1.0, -0.2, -0.1)))),
    }
)
"""The strokes of the task `writer`, one a variant, all beside the pen's start."""


def draw(stroke: Stroke, simulator: Simulator) -> NDArray[np.uint16]:
    """Make a target with a stroke.

    Args:
        stroke: The motion.
        simulator: A simulator of the scene; in float64 the result is the same on every machine.

    Returns:
        Particle positions (N, 3) in units of 1/POSITION_SCALE.
    """
    state = simulator.initial_state(batch_size=1)
    pose = state.manipulator_pose.clone()
    pose[0, 0, :3] = torch.tensor(stroke.start, dtype=pose.dtype)
    actions = stroke.actions(simulator.scene.action_size).unsqueeze(0)
    trajectory = simulator.rollout(state.with_manipulators(pose), actions)
    position = trajectory.positions[0, -1].double().cpu().numpy()
    return np.round(position * POSITION_SCALE).astype(np.uint16)
