"""Trajectories in ManiSkill's layout: HDF5 files with a group for each episode, and a JSON file beside each.

The names ``obs``, ``actions``, ``rewards``, ``success``, ``terminated``, ``truncated`` and ``env_states`` mean what they mean in
ManiSkill's own files; what it has no name for is in the group ``plan``.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from cpdeform.datasets.episode import Episode
from cpdeform.run.record_files import replacing, replacing_hdf5, to_json

DATASET = "dataset"
"""Directory of the data set, in that of its plans."""

FILE = "trajectories-{:05d}"
CONTROL_MODE = "tool_velocity"
"""ManiSkill's name for how actions are meant: each moves a tool at a velocity, in its own scale."""

FORMAT = 1


@dataclasses.dataclass(frozen=True, kw_only=True)
class EpisodeLabel:
    """What is told about an episode beside its arrays.

    Attributes:
        goal_seed: Seed of its goal.
        goal_kind: What the goal is.
        job: Name of the job that planned it.
        figures: Figures of its run.
    """

    goal_seed: int
    goal_kind: str
    job: str
    figures: Mapping[str, Any]


def write_trajectories(
    directory: Path, number: int, episodes: Iterable[tuple[EpisodeLabel, Episode]], *, first: int, environment: Mapping[str, Any]
) -> list[dict[str, Any]]:
    """Write a shard, an HDF5 file and the JSON file that belongs to it.

    Args:
        directory: Where.
        number: Number of the shard.
        episodes: Its episodes, with their labels.
        first: Number of the first episode within the data set.
        environment: What is needed to simulate them again.

    Returns:
        What the JSON file says about each episode.
    """
    said = []
    name = FILE.format(number)
    with replacing_hdf5(directory / f"{name}.h5") as file:
        file.attrs["format"] = FORMAT
        for index, (label, episode) in enumerate(episodes):
            _write(file.create_group(f"traj_{index}"), episode)
            said.append(
                {
                    "episode_id": index,
                    "number": first + index,
                    "episode_seed": label.goal_seed,
                    "control_mode": CONTROL_MODE,
                    "elapsed_steps": episode.steps,
                    "reset_kwargs": {"options": {"goal_seed": label.goal_seed, "goal_kind": label.goal_kind}},
                    "success": episode.succeeded,
                    "job": label.job,
                    "losses": episode.losses.tolist(),
                    "incremental_iou": float(episode.rewards.sum()),
                    **{name: label.figures.get(name) for name in ("status", "metric", "metric_value", "seconds", "cpu_seconds")},
                }
            )
    content = {
        "env_info": {
            "env_id": f"cpdeform/{environment['task']['name']}",
            "max_episode_steps": max((item["elapsed_steps"] for item in said), default=0),
            "env_kwargs": environment,
        },
        "episodes": said,
        "source_type": "motionplanning",
        "source_desc": "plans of cpdeform for generated goals",
        "commit_info": None,
    }
    with replacing(directory / f"{name}.json") as temporary:
        temporary.write_text(json.dumps(to_json(content), indent=1) + "\n", encoding="utf-8")
    return said


def _write(group: h5py.Group, episode: Episode) -> None:
    units = "length (domain edge = 1)"
    poses = "position: length; unit quaternion wxyz: 1; gap: length"
    end = np.zeros(episode.steps, dtype=bool)
    end[-1] = True
    for name, values, shape, unit in (
        ("obs/particles", episode.particles, "time (T + 1), particle, xyz", units),
        ("obs/tool_poses", episode.tool_poses.astype(np.float32), "time (T + 1), tool, xyz wxyz gap", poses),
        ("actions", episode.actions, "step (T), action", "1, in [-1, 1]"),
        ("rewards", episode.rewards, "step (T)", "increment of the normalised IoU"),
        ("success", episode.success, "step (T)", "whether the state after the step is near enough to the goal"),
        ("terminated", end & episode.success, "step (T)", "whether the episode ended in success"),
        ("truncated", end & ~episode.success, "step (T)", "whether it ended otherwise"),
        ("env_states/tool_poses", episode.tool_poses, "time (T + 1), tool, xyz wxyz gap", poses),
        ("plan/placed", episode.placed, "step (T)", "whether the tools were put to their poses before the step"),
        ("plan/stage_starts", episode.stage_starts, "stage (S)", "step"),
        ("plan/priorities", episode.priorities, "stage (S), particle", "transport cost, or length"),
        ("plan/losses", episode.losses, "start and stages (S + 1)", "objective"),
        ("plan/observed", episode.observed, "particle", "index of an observed particle"),
        ("plan/goal", episode.goal, "goal particle, xyz", units),
        ("plan/final_positions", episode.final_positions, "all particles, xyz", units),
    ):
        packed: dict[str, Any] = {"compression": "gzip", "compression_opts": 4, "shuffle": True} if values.size > 1000 else {}
        dataset = group.create_dataset(name, data=values, **packed)
        dataset.attrs["shape"], dataset.attrs["units"] = shape, unit
    group["plan"].attrs["corresponds"] = episode.corresponds


def read_trajectory(group: h5py.Group) -> Episode:
    """Read an episode back."""
    plan = group["plan"]
    return Episode(
        actions=group["actions"][()],
        placed=plan["placed"][()],
        tool_poses=group["env_states/tool_poses"][()],
        particles=group["obs/particles"][()],
        observed=plan["observed"][()],
        rewards=group["rewards"][()],
        success=group["success"][()],
        stage_starts=plan["stage_starts"][()],
        priorities=plan["priorities"][()],
        losses=plan["losses"][()],
        goal=plan["goal"][()],
        corresponds=bool(plan.attrs["corresponds"]),
        final_positions=plan["final_positions"][()],
    )
