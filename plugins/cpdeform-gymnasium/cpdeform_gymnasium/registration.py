"""The names of the environments: every task and variant, under cpdeform's names and under PlasticineLab's."""

from __future__ import annotations

import re
import warnings
from collections.abc import Mapping
from typing import Any

import gymnasium

from cpdeform.core.errors import CpdeformError
from cpdeform.core.plugins import Registry, load_registry
from cpdeform.core.reading.yaml_text import read_yaml
from cpdeform.core.task import task_path

NAMESPACE = "cpdeform"
ANY_TASK = f"{NAMESPACE}/Task-v0"
"""The environment whose task is an argument: ``gymnasium.make("cpdeform/Task-v0", task="my_vase.yaml")``."""

LEAST_STEPS = 50
"""Steps of PlasticineLab's episodes; those of a task that takes more have as many as all of its stages."""


def environment_ids(*, registry: Registry | None = None) -> dict[str, str]:
    """Tasks by the names of their environments: ``"cpdeform/Writer-v2"`` and ``"cpdeform/writer-v2"`` are the task ``writer-v2``.

    A task without variants is version 1; ``++`` is not allowed in Gymnasium's names and is spelt out.

    Args:
        registry: Where tasks are looked up; defaults to the installed plugins.
    """
    return {name: task for name, (task, _) in _environments(registry or load_registry()).items()}


def plasticinelab_name(task: str) -> str:
    """A task's name as PlasticineLab writes it: ``"RollingPin"`` of ``"rolling-pin"``."""
    return "".join(part.capitalize() for part in re.split(r"\W+", _spelt(task)) if part)


def register(*, registry: Registry | None = None) -> None:
    """Register all environments with Gymnasium; those that are registered already are left as they are.

    Args:
        registry: Where tasks are looked up; defaults to the installed plugins.
    """
    for name, (task, steps) in _environments(registry or load_registry()).items():
        _register(name, max_episode_steps=steps, task=task)
    _register(ANY_TASK, max_episode_steps=LEAST_STEPS)
    # Versions are variants, as PlasticineLab has them; Gymnasium takes all but the last one for outdated.
    warnings.filterwarnings("ignore", message=rf".*environment {NAMESPACE}/\S+ is out of date")


def _register(name: str, *, max_episode_steps: int, **arguments: str) -> None:
    if name not in gymnasium.registry:
        gymnasium.register(
            id=name,
            entry_point="cpdeform_gymnasium.environment:DeformEnv",
            vector_entry_point="cpdeform_gymnasium.vector:DeformVectorEnv",
            max_episode_steps=max_episode_steps,
            kwargs=arguments,
        )


def _environments(registry: Registry) -> dict[str, tuple[str, int]]:
    """Task and steps of an episode by the name of the environment."""
    found = {}
    for name in registry.names("task"):
        content = _content(name, registry)
        variants = [str(variant) for variant in content.get("variants") or () if re.fullmatch(r"v\d+", str(variant))]
        versions = {variant: f"{name}-{variant}" for variant in variants} or {"v1": name}
        for version, task in versions.items():
            for alias in (plasticinelab_name(name), _spelt(name)):
                found[f"{NAMESPACE}/{alias}-{version}"] = (task, _steps(content))
    return found


def _content(task: str, registry: Registry) -> dict[str, Any]:
    """What a task's file says, not validated: `gymnasium.make` will tell what is wrong with it."""
    try:
        content = read_yaml(task_path(task, registry=registry), argument=f"task {task}")
    except CpdeformError:
        return {}
    return content if isinstance(content, dict) else {}


def _steps(content: Mapping[str, Any]) -> int:
    """Steps of an episode: PlasticineLab's, or those of all stages where these are more."""
    try:
        stage = int(content.get("step_count", 10)) + int(content.get("rest_steps", 0))
        return episode_steps(stage, int(content.get("stage_count", 1)))
    except (TypeError, ValueError):
        return LEAST_STEPS


def episode_steps(stage: int, stages: int) -> int:
    """Steps of an episode, from those of a stage and the number of stages."""
    return max(LEAST_STEPS, stages * stage)


def _spelt(task: str) -> str:
    return task.replace("++", "-plus-plus")
