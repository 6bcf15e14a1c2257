"""What a learner is trained with; kept beside its checkpoints."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal, get_args

from pydantic import Field

from cpdeform.core.bounded import MOST_COUNT, Count, Seed, Whole
from cpdeform.core.errors import InputError
from cpdeform.core.model import FrozenModel
from cpdeform.core.reading.json_text import read_json
from cpdeform.core.reading.models import validate
from cpdeform.run.record_files import write_json

CONFIGURATION_FILE = "learner.json"

Algorithm = Literal["sac", "ppo", "td3", "shac"]
ALGORITHMS: tuple[str, ...] = get_args(Algorithm)

PRESETS: Mapping[str, Mapping[str, int]] = MappingProxyType(
    {
        "quick": MappingProxyType({"steps": 2_000, "worlds": 4}),
        # 1,000 episodes of 1,000 steps, as the paper gives its learners.
        "paper": MappingProxyType({"steps": 1_000_000, "worlds": 8, "episode_steps": 1_000, "checkpoint_every": 50_000}),
    }
)
"""Budgets by name."""


class LearnerConfiguration(FrozenModel):
    """What a policy is trained with.

    Attributes:
        task: Registered name or path of a YAML file.
        algorithm: ``"sac"``, ``"ppo"`` or ``"td3"`` of stable-baselines3, or ``"shac"``, through the simulator's gradient.
        steps: Environment steps of all worlds together.
        worlds: Worlds that are stepped together.
        episode_steps: Steps of an episode; None for those of the task's environment.
        seed: Seed of policy, exploration and starts.
        backend: Registered name of the simulator, or ``"auto"``.
        device: Where the simulator and the networks are.
        reward: Name of the reward, see `cpdeform_gymnasium`.
        checkpoint_every: Steps between checkpoints.
        options: Further keyword options of the algorithm.
    """

    task: str
    algorithm: Algorithm = "sac"
    steps: Whole = Field(default=20_000, ge=1, le=MOST_COUNT)
    worlds: Count = 8
    episode_steps: Count | None = None
    seed: Seed = 0
    backend: str = "auto"
    device: str = "cpu"
    reward: str = "auto"
    checkpoint_every: Count = 5_000
    options: dict[str, Any] = Field(default_factory=dict)


def read_configuration(directory: Path) -> LearnerConfiguration:
    """The configuration of a training that is there already.

    Raises:
        InputError: There is none, or it cannot be used.
    """
    path = directory / CONFIGURATION_FILE
    if not path.is_file():
        remedy = "Give the --out of an earlier `cpdeform rl`."
        raise InputError("--resume", came=str(directory), expected=f"a directory with a {CONFIGURATION_FILE}", remedy=remedy)
    return validate(LearnerConfiguration, read_json(path, argument=str(path)), source=str(path))


def write_configuration(configuration: LearnerConfiguration, directory: Path) -> None:
    """Keep a configuration."""
    directory.mkdir(parents=True, exist_ok=True)
    write_json(directory / CONFIGURATION_FILE, configuration.model_dump(mode="json"))
