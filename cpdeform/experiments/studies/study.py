"""What the further experiments run by default, and what their presets set."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

from cpdeform.core.errors import UnknownNameError
from cpdeform.experiments.experiment_plan import MULTI_STAGE, TASKS

SEARCH, ABLATION, RUNTIME, RIVALS, LANDSCAPE = "search", "ablation", "runtime", "rivals", "landscape"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Study:
    """An experiment whose figures are made from several runs.

    Attributes:
        title: What it shows.
        methods: Methods that it compares unless others are asked for.
        tasks: Tasks that it takes unless others are asked for.
        equal_cost: Whether all methods may spend as much a stage as the reference did.
    """

    title: str
    methods: tuple[str, ...]
    tasks: tuple[str, ...] = TASKS[MULTI_STAGE]
    equal_cost: bool = False


STUDIES: Mapping[str, Study] = MappingProxyType(
    {
        SEARCH: Study(
            title="Contact points by transport, and by searches that know nothing of it",
            methods=("cpdeform", "random", "restarts", "bayesopt"),
        ),
        ABLATION: Study(title="Contact points by transport, and at random: learning curves", methods=("cpdeform", "random")),
        RUNTIME: Study(
            title="Best loss against wall time",
            methods=("cpdeform", "random", "restarts", "bayesopt"),
        ),
        RIVALS: Study(
            title="All methods at equal cost",
            methods=(
                "cpdeform",
                "sculpt",
                "fixed",
                "random",
                "restarts",
                "bayesopt",
                "cma",
                "mppi",
                "sampled-gradients",
                "sac",
                "ppo",
                "td3",
            ),
            equal_cost=True,
        ),
    }
)
"""The experiments by name; `landscape` is of another kind."""

PRESETS: Mapping[str, Mapping[str, Any]] = MappingProxyType(
    {
        # A run within two minutes of one core. All particles stay: goals that are the body's particles, moved, need them.
        "quick": MappingProxyType({"seeds": "0,1,2", "iterations": 6, "stages": 1}),
        # Enough for methods to show what they can do, within about ten minutes a run.
        "standard": MappingProxyType({"seeds": "0,1,2", "iterations": 20, "stages": 3}),
        "paper": MappingProxyType({"seeds": "0,1,2,3,4"}),
    }
)
"""Values of the options of `cpdeform experiment` where none are given."""

LANDSCAPE_PRESETS: Mapping[str, Mapping[str, Any]] = MappingProxyType(
    {
        "quick": MappingProxyType({"size": 8, "iterations": 4}),
        "standard": MappingProxyType({"size": 12, "iterations": 20}),
        "paper": MappingProxyType({"size": 20}),
    }
)
"""Those of the landscape."""


def preset(name: str, *, experiment: str) -> Mapping[str, Any]:
    """The values of a preset.

    Args:
        name: Name of the preset.
        experiment: Name of the experiment.

    Raises:
        UnknownNameError: There is none of that name.
    """
    presets = LANDSCAPE_PRESETS if experiment == LANDSCAPE else PRESETS
    if name not in presets:
        raise UnknownNameError("--preset", name, presets)
    return presets[name]
