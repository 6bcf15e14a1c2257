"""Run records of earlier versions: what their files, arrays and fields are called now.

Format 1: strategies were an option `algorithm`, and tasks had settings. Format 2: a goal was a `target`, tools were
`manipulators`. Format 3 is today's.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from cpdeform.core.old_names import current_options
from cpdeform.core.old_names import current_task as current_fields
from cpdeform.core.reading.array_file import ArrayFile
from cpdeform.run.record_files import GOAL_FILE, OLD_GOAL_FILE

PLACER_OPTIONS = {"transport": {"poses": "proposers", "attempts": "rounds"}, "random": {"attempts": "draws"}}
"""Options of placers that had other names in records of format 1."""

ARRAY_NAMES = {"tool_poses": "manipulator_poses", "tool_pose": "manipulator_pose"}
"""Arrays of a stage that had other names up to format 2."""


def current_configuration(content: Mapping[str, Any], *, record_format: int) -> dict[str, Any]:
    """The configuration of a record under today's names.

    Args:
        content: The configuration in ``run.json``.
        record_format: The record's format.

    Raises:
        InputError: A field is there under its old and its new name.
    """
    result: dict[str, Any] = dict(content) if record_format >= 3 else current_options(content)
    if record_format >= 2:
        return result
    if "algorithm" in result:
        result["strategy"] = "paper" if result.pop("algorithm") == "paper" else "cpdeform"
    optimizer = result.get("optimizer")
    if isinstance(optimizer, dict) and "schedule" in optimizer:
        rest = {key: value for key, value in optimizer.items() if key != "schedule"}
        result["optimizer"] = {**rest, "pruner": "none" if optimizer["schedule"] == "paper" else optimizer["schedule"]}
    options = result.get("placer_options")
    if isinstance(options, dict):
        names = PLACER_OPTIONS.get(str(result.get("placer", "transport")), {})
        result["placer_options"] = {names.get(key, key): value for key, value in options.items()}
    return result


def current_task(content: Any, *, record_format: int) -> Any:
    """The task of a record under today's names; its settings are in the configuration, and its limits in its scene.

    Args:
        content: The task in ``run.json``.
        record_format: The record's format.

    Raises:
        InputError: A field is there under its old and its new name.
    """
    if record_format >= 3 or not isinstance(content, dict):
        return content
    content = current_fields(content)
    return {key: value for key, value in content.items() if key != "settings" or record_format >= 2}


def goal_file(directory: Path) -> Path:
    """The file of a record's goal: today's, or the old one where only that is there."""
    path, old = directory / GOAL_FILE, directory / OLD_GOAL_FILE
    return old if old.is_file() and not path.is_file() else path


def array_name(file: ArrayFile, name: str) -> str:
    """The name of a stage's array in its file: today's, or the old one where the file has that instead."""
    folder, slash, last = name.rpartition("/")
    old = f"{folder}{slash}{ARRAY_NAMES.get(last, last)}"
    return old if name not in file and old in file else name
