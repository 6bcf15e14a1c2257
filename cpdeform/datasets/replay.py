"""Episodes of a data set simulated again, by the simulator that made them or another one."""

from __future__ import annotations

import dataclasses
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import h5py
import torch

from cpdeform.core.errors import InputError
from cpdeform.core.goal import write_goal
from cpdeform.core.plugins import Registry, load_registry
from cpdeform.core.reading.json_text import read_json
from cpdeform.core.reading.limits import ReadingLimits
from cpdeform.core.reading.models import validate
from cpdeform.core.simulator import Simulator
from cpdeform.core.task import Task
from cpdeform.datasets.episode import Episode
from cpdeform.datasets.trajectories import DATASET, read_trajectory
from cpdeform.run.configuration import RunConfiguration
from cpdeform.run.parts import make_objective

MOST_BYTES = 2**30
"""Bytes of a shard's JSON file at most."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Replay:
    """An episode that was simulated again.

    Attributes:
        number: Number of the episode within the data set.
        backend: The simulator.
        distance: Largest distance of a particle from where the data set has it at the end, length units.
        loss: Loss at the end, units of the objective.
        recorded_loss: What the data set says.
    """

    number: int
    backend: str
    distance: float
    loss: float
    recorded_loss: float

    @property
    def equal(self) -> bool:
        """Whether every particle ends where the data set has it, to the last digit."""
        return self.distance == 0.0

    @property
    def loss_difference(self) -> float:
        """Difference of the losses over the recorded one."""
        return abs(self.loss - self.recorded_loss) / abs(self.recorded_loss)


def replay(
    directory: Path, *, episodes: Sequence[int] | None = None, backend: str | None = None, registry: Registry | None = None
) -> Iterator[Replay]:
    """Simulate episodes again, from the scene's start, stage by stage.

    Args:
        directory: The data set, or the directory that it was made in.
        episodes: Numbers of the episodes; defaults to all.
        backend: Registered name of the simulator; defaults to the one that made the data set.
        registry: Where names are looked up; defaults to the installed plugins.

    Returns:
        What came of each.

    Raises:
        InputError: There is no data set, no such episode, or a file is damaged.
    """
    registry = registry or load_registry()
    shards = sorted(_dataset(directory).glob("trajectories-*.json"))
    if not shards:
        raise InputError(f"data set {directory}", came="no trajectories", expected="a data set of `cpdeform dataset new`")
    wanted = None if episodes is None else set(episodes)
    for shard in shards:
        content = read_json(shard, argument=str(shard), limits=ReadingLimits(text_bytes=MOST_BYTES))
        kwargs, said = content["env_info"]["env_kwargs"], content["episodes"]
        with h5py.File(shard.with_suffix(".h5"), "r") as file:
            for item in said:
                if wanted is not None and item["number"] not in wanted:
                    continue
                wanted = None if wanted is None else wanted - {item["number"]}
                episode = read_trajectory(file[f"traj_{item['episode_id']}"])
                yield _replay(item["number"], episode, kwargs, backend, registry)
    if wanted:
        raise InputError("--episodes", came=", ".join(map(str, sorted(wanted))), expected="numbers of episodes of the data set")


def _dataset(directory: Path) -> Path:
    return directory / DATASET if (directory / DATASET).is_dir() else directory


def _replay(number: int, episode: Episode, kwargs: Mapping[str, Any], backend: str | None, registry: Registry) -> Replay:
    configuration = validate(
        RunConfiguration, {**kwargs["configuration"], "task": "writer"}, source="configuration of the data set"
    )
    name = configuration.backend if backend is None else registry.resolve("simulator", backend, device="cpu")
    with tempfile.TemporaryDirectory(prefix="cpdeform-replay-") as folder:
        path = Path(folder) / "goal.npz"
        write_goal(path, episode.goal, corresponds=episode.corresponds)
        task = validate(Task, {**kwargs["task"], "goal": path}, source="task of the data set")
        options = configuration.simulator_options if name == configuration.backend else {}
        simulator = _simulator(name, task, options, kwargs.get("threads"), registry)
        objective = make_objective(task, configuration.ot, simulator, options=configuration.objective, registry=registry)
        state = simulator.initial_state(batch_size=1)
        actions, poses = torch.as_tensor(episode.actions), torch.as_tensor(episode.tool_poses)
        ends = [*episode.stage_starts[1:].tolist(), episode.steps]
        for start, end in zip(episode.stage_starts.tolist(), ends, strict=True):
            placed = state.with_tools(poses[start].unsqueeze(0))
            trajectory = simulator.rollout(placed, actions[start:end].unsqueeze(0).to(placed.position))
            state = trajectory.final_state
        loss = float(objective.evaluate(trajectory).loss[0])
    recorded = torch.as_tensor(episode.final_positions)
    distance = float((state.position[0].cpu().double() - recorded.double()).norm(dim=-1).max())
    return Replay(number=number, backend=name, distance=distance, loss=loss, recorded_loss=float(episode.losses[-1]))


def _simulator(name: str, task: Task, options: Mapping[str, Any], threads: int | None, registry: Registry) -> Simulator:
    """A simulator with as many threads as the plans were made with: sums depend on their number in the last digits."""
    known = registry.option_names("simulator", name)
    own = {"threads": threads} if threads is not None and (known is None or "threads" in known) else {}
    made: Simulator = registry.create("simulator", name, scene=task.scene, **{**own, **options, "batch_size": 1})
    return made
