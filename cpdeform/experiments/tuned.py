"""The settings that the results page was made with, task by task."""

from __future__ import annotations

import importlib.resources
import re
from collections.abc import Mapping
from typing import Any

from cpdeform.core.task import Task
from cpdeform.planning.strategies.cpdeform import StrategyCpdeform

SETTINGS_FILE = "tuned.yaml"


class StrategyTuned(StrategyCpdeform):
    """The default strategy with settings that were chosen for each of the paper's tasks, in ``tuned.yaml`` beside this file.

    It repeats the runs of docs/results.md. For a task that the file does not know it is the default strategy. Settings of the
    placer count for the placer ``transport``.
    """

    def settings(self, task: Task, *, placer: str | None) -> Mapping[str, Any]:
        """The file's settings of the task, whatever its variant."""
        own = tuned_settings().get(re.sub(r"-v\d+$", "", task.name))
        if own is None:
            return super().settings(task, placer=placer)
        return {key: value for key, value in own.items() if key != "placer_options" or (placer or "transport") == "transport"}


def tuned_settings() -> dict[str, dict[str, Any]]:
    """Settings by the name of the task, as in the file."""
    import yaml

    text = importlib.resources.files("cpdeform.experiments").joinpath(SETTINGS_FILE).read_text(encoding="utf-8")
    content: dict[str, dict[str, Any]] = yaml.safe_load(text)
    return content
