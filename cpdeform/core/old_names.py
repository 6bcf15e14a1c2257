"""Names of earlier versions, in files and options of users: what is given under an old name is taken under today's.

A task had a `target`, which is its `goal` now, and a scene had `manipulators`, which are its `tools`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from cpdeform.core.errors import InputError

SCENE_NAMES = {"manipulators": "tools"}
TASK_NAMES = {"target": "goal"}


def current_scene(content: Any) -> Any:
    """Fields of a scene, or changes of them, under today's names.

    Args:
        content: A mapping; anything else is returned as it is.

    Raises:
        InputError: A field is given under both names.
    """
    return _renamed(content, SCENE_NAMES)


def current_task(content: Any) -> Any:
    """Fields of a task under today's names, those of its scene, limits and variants included.

    Args:
        content: A mapping; anything else is returned as it is.

    Raises:
        InputError: A field is given under both names.
    """
    result = current_options(content)
    if isinstance(result, dict) and "limits" in result:
        result["limits"] = current_scene(result["limits"])
    if isinstance(result, dict) and isinstance(result.get("variants"), Mapping):
        result["variants"] = {name: current_task(changes) for name, changes in result["variants"].items()}
    return result


def current_options(content: Any) -> Any:
    """Fields of a run's configuration under today's names.

    Args:
        content: A mapping; anything else is returned as it is.

    Raises:
        InputError: A field is given under both names.
    """
    result = _renamed(content, TASK_NAMES)
    if isinstance(result, dict) and "scene" in result:
        result["scene"] = current_scene(result["scene"])
    return result


def _renamed(content: Any, names: Mapping[str, str]) -> Any:
    if not isinstance(content, Mapping):
        return content
    for old, new in names.items():
        if old in content and new in content:
            raise InputError(
                old, came=f"both `{old}` and `{new}`", expected=f"`{new}` alone", remedy=f"Remove `{old}`, the old name of `{new}`."
            )
    return {names.get(key, key) if isinstance(key, str) else key: value for key, value in content.items()}
