"""What a policy is worth: one episode from the task's very start, without exploration."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cpdeform_gymnasium import DeformEnv

Policy = Callable[[NDArray[np.float32]], NDArray[Any]]
"""Actions (A,) from an observation (O,)."""


@dataclasses.dataclass(frozen=True)
class EpisodeFigures:
    """An episode.

    Attributes:
        episode_return: Sum of the rewards, not discounted.
        steps: Environment steps.
        w1: W1 at its end, length units.
        incremental_iou: Normalised incremental IoU at its end.
    """

    episode_return: float
    steps: int
    w1: float
    incremental_iou: float


def run_episode(environment: DeformEnv, policy: Policy, *, steps: int) -> EpisodeFigures:
    """Let a policy act for an episode.

    Args:
        environment: Where.
        policy: What acts.
        steps: Steps of the episode; it ends earlier where the simulation diverges.
    """
    observation, info = environment.reset(seed=0)
    total, taken = 0.0, 0
    for _ in range(steps):
        action = np.clip(policy(observation), -1.0, 1.0).astype(np.float32)
        observation, reward, terminated, _, info = environment.step(action)
        total, taken = total + reward, taken + 1
        if terminated:
            break
    return EpisodeFigures(total, taken, info["w1"], info["incremental_iou"])
