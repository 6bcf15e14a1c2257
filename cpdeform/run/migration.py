"""Run records of earlier versions: what their fields are called now."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

PLACER_OPTIONS = {"transport": {"poses": "proposers", "attempts": "rounds"}, "random": {"attempts": "draws"}}
"""Options of placers that had other names in records of format 1."""


def current_configuration(content: Mapping[str, Any], *, record_format: int) -> dict[str, Any]:
    """The configuration of a record under today's names.

    Args:
        content: The configuration in ``run.json``.
        record_format: The record's format.
    """
    result = dict(content)
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
    """The task of a record under today's names; its settings are in the configuration, and its limits in its scene."""
    if record_format >= 2 or not isinstance(content, dict):
        return content
    return {key: value for key, value in content.items() if key != "settings"}
