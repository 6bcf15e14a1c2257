"""Where each value of a run's configuration comes from."""

from __future__ import annotations

import enum
from collections.abc import Mapping, Sequence
from typing import Any


class Origin(enum.StrEnum):
    """Who set a value."""

    GIVEN = "given"
    """The user, by a flag, ``--set`` or an argument in Python."""
    OBJECT = "object"
    """The user, by an object in Python that takes the place of a name."""
    RECORD = "record"
    """The record that the run went on from."""
    STRATEGY = "strategy"
    """The settings of the strategy."""
    AUTO = "auto"
    """The choice among what is installed."""
    DEFAULT = "default"
    """The default."""


def flatten(content: Mapping[str, Any], *, prefix: str = "") -> dict[str, Any]:
    """The values of nested mappings by their paths, ``{"a": {"b": 1}}`` as ``{"a.b": 1}``; an empty mapping is a value."""
    result: dict[str, Any] = {}
    for key, value in content.items():
        path = f"{prefix}{key}"
        if isinstance(value, Mapping) and value:
            result |= flatten(value, prefix=f"{path}.")
        else:
            result[path] = value
    return result


def trace_origins(configuration: Mapping[str, Any], layers: Sequence[tuple[Origin, Mapping[str, Any]]]) -> dict[str, str]:
    """Find where each value of a configuration comes from.

    Args:
        configuration: The configuration, nested.
        layers: Who set which values, nested; the first one that sets a value has it.

    Returns:
        The origin of each value by its path, e.g. ``{"optimizer.iterations": "given"}``.
    """
    flat_layers = [(origin, flatten(values)) for origin, values in layers]
    return {path: _origin(path, flat_layers) for path in flatten(configuration)}


def _origin(path: str, layers: Sequence[tuple[Origin, Mapping[str, Any]]]) -> str:
    for origin, values in layers:
        if path in values or any(path.startswith(f"{other}.") for other in values):
            return origin.value
    return Origin.DEFAULT.value
