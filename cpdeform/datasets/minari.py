"""The same episodes as a Minari data set."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import gymnasium
import minari
import numpy as np
from minari.data_collector import EpisodeBuffer
from minari.dataset.minari_storage import MinariStorage

from cpdeform.datasets.episode import Episode


class MinariWriter:
    """Writes episodes to a Minari data set, one after the other.

    Args:
        directory: Where; must not hold one.
        name: Name of the data set.
        sample: An episode of it, for the shapes.
        fields: Further metadata, such as a description.
    """

    def __init__(self, directory: Path, *, name: str, sample: Episode, fields: dict[str, Any]) -> None:
        poses = sample.tool_poses.shape[1:]
        box = gymnasium.spaces.Box
        observations = gymnasium.spaces.Dict(
            {
                "particles": box(-np.inf, np.inf, sample.particles.shape[1:], np.float32),
                "tool_poses": box(-np.inf, np.inf, poses, np.float32),
            }
        )
        actions = box(-1.0, 1.0, sample.actions.shape[1:], np.float32)
        # Minari joins a relative directory to itself.
        directory = directory.resolve()
        directory.mkdir(parents=True, exist_ok=True)
        self._storage = MinariStorage.new(directory, observation_space=observations, action_space=actions, jpeg_encoding=False)
        self._storage.update_metadata({"dataset_id": name, "minari_version": minari.__version__, **fields})

    def write(self, episodes: Iterable[tuple[int, Episode]]) -> None:
        """Append episodes.

        Args:
            episodes: Seed of the goal, and the episode.
        """
        self._storage.update_episodes(_buffer(seed, episode) for seed, episode in episodes)


def _buffer(seed: int, episode: Episode) -> EpisodeBuffer:
    end = np.arange(episode.steps) == episode.steps - 1
    return EpisodeBuffer(
        seed=seed,
        observations={"particles": episode.particles, "tool_poses": episode.tool_poses.astype(np.float32)},
        actions=episode.actions.astype(np.float32),
        rewards=list(episode.rewards),
        terminations=list(end & episode.success),
        truncations=list(end & ~episode.success),
        infos={
            "goal": episode.goal,
            "placed": episode.placed,
            "stage_starts": episode.stage_starts,
            "priorities": episode.priorities,
            "success": episode.success,
        },
    )
