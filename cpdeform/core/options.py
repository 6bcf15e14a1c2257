"""Options of parts: plain Python values, checked when a part is made, so that none fails or hangs deep inside of it."""

from __future__ import annotations

import numbers
from typing import Any

from cpdeform.core.errors import InputError, brief

MOST_THREADS = 4096
"""Threads at most: each takes a stack of its own."""


def whole_number(name: str, value: Any, *, least: int, most: int, remedy: str = "") -> int:
    """A whole number within bounds; a truth value or a text is none.

    Args:
        name: Name of the option.
        value: What was given.
        least: The smallest number accepted.
        most: The largest.
        remedy: What the user can do otherwise.

    Raises:
        InputError: It is something else, or out of bounds.
    """
    number = _number(value)
    if number is None or not least <= number <= most or not float(number).is_integer():
        bounds = f"at least {least}, at most {most}"
        raise InputError(name, came=_shown(value), expected=f"a whole number, {bounds}", remedy=remedy)
    return int(number)


def real_number(name: str, value: Any, *, least: float, most: float, expected: str = "", remedy: str = "") -> float:
    """A finite number within bounds; a truth value or a text is none.

    Args:
        name: Name of the option.
        value: What was given.
        least: The smallest number accepted.
        most: The largest.
        expected: What is accepted, where the bounds alone do not say it well.
        remedy: What the user can do otherwise.

    Raises:
        InputError: It is something else, or out of bounds.
    """
    number = _number(value)
    if number is None or not least <= number <= most:
        bounds = f"{least:g} to {most:g}"
        raise InputError(name, came=_shown(value), expected=f"{expected} ({bounds})" if expected else bounds, remedy=remedy)
    return float(number)


def _number(value: Any) -> int | float | None:
    """A real number as Python's own; None for anything else."""
    if isinstance(value, bool) or not isinstance(value, numbers.Real):
        return None
    return int(value) if isinstance(value, numbers.Integral) else float(value)


def _shown(value: Any) -> str:
    number = _number(value)
    if number is None:
        return brief(f"{type(value).__name__} {value!r}", 100)
    # A number with thousands of digits cannot be written out.
    return brief(f"{value}", 60) if not abs(number) > 1e30 else f"{type(value).__name__} beyond 1e30"
