"""What a data set consists of."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

from cpdeform.core.errors import InputError

DEFAULT_LICENCE = "CC-BY-4.0"


@dataclasses.dataclass(frozen=True, kw_only=True)
class DatasetSettings:
    """What to plan and what to write of it.

    Attributes:
        scene: Task whose scene the goals are for: a registered name, or the path of a YAML file.
        goals: Seeds of the goals, one plan each; see `cpdeform.tasks.generate.goal.generate_goal`.
        settings: Fields of `RunConfiguration` for all plans, nested.
        seed: Seed of all plans.
        threads: Threads of each plan.
        particles: Particles of an observation, a fixed random subset of the clay's; all, where it has no more.
        success_iou: Normalised incremental IoU from which on a state counts as a success.
        shard_size: Trajectories of a file.
        licence: Licence of the data, an SPDX identifier.

    Raises:
        InputError: A number is out of range, or a goal is there twice.
    """

    scene: str
    goals: tuple[int, ...]
    settings: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    seed: int = 0
    threads: int = 1
    particles: int = 1000
    success_iou: float = 0.5
    shard_size: int = 100
    licence: str = DEFAULT_LICENCE

    def __post_init__(self) -> None:
        if not self.goals or len(set(self.goals)) < len(self.goals):
            raise InputError("--goals", came="a seed twice, or none", expected="seeds, each once")
        for name in ("threads", "particles", "shard_size"):
            if getattr(self, name) < 1:
                raise InputError(f"--{name.replace('_', '-')}", came=str(getattr(self, name)), expected="at least 1")
        if not 0.0 < self.success_iou <= 1.0:
            raise InputError("--success-iou", came=str(self.success_iou), expected="a number above 0, of at most 1")
        if not self.licence.strip():
            raise InputError("--licence", came="nothing", expected="an SPDX identifier, such as CC-BY-4.0")
        for field, option in (("task", "--scene"), ("goal", "--goals"), ("seed", "--seed")):
            if field in self.settings:
                raise InputError("--set", came=f'"{field}"', expected="another field", remedy=f"Use {option} instead.")
