"""Numbers of the data models: one rule for all fields, and bounds that are generous but finite.

A truth value or a text is no number, not even ``true`` or ``"5"``; a number without a fraction is a whole number, also as ``1e3``.
The bounds keep out what can only be a slip of the keyboard, before memory or hours are spent on it.
"""

from __future__ import annotations

import numbers
from typing import Annotated, Any

from pydantic import AfterValidator, BeforeValidator, Field, Strict, StringConstraints

MOST_PARTICLES = 10_000_000
"""Particles of a scene, or of a goal that is made, at most."""

MOST_STEPS = 100_000
"""Environment steps of a stage, or substeps of a step, at most."""

MOST_STAGES = 10_000
"""Stages of a run at most."""

MOST_COUNT = 10**9
"""The most of anything that is counted and costs no memory, such as iterations."""

MOST_SEED = 2**63 - 1
"""Largest seed: what fits into a signed number of 64 bits, as every generator of random numbers takes it."""

MOST_PARTS = 100
"""Bodies, or tools, of a scene at most."""


def _whole(value: Any) -> Any:
    """A whole number as `int`, whatever type holds it; anything else as it is, for pydantic to refuse."""
    if isinstance(value, bool):
        return value
    if isinstance(value, numbers.Integral):
        return int(value)
    # isinstance of the abstract class: NumPy's numbers of single precision are no `float`.
    return int(float(value)) if isinstance(value, numbers.Real) and float(value).is_integer() else value


def _real(value: Any) -> Any:
    """A real number as `float`; anything else as it is, for pydantic to refuse."""
    if isinstance(value, bool) or not isinstance(value, numbers.Real):
        return value
    try:
        return float(value)
    except OverflowError:
        return float("inf")


Whole = Annotated[int, BeforeValidator(_whole), Strict()]
Real = Annotated[float, BeforeValidator(_real), Strict(), Field(allow_inf_nan=False)]
Count = Annotated[Whole, Field(ge=1, le=MOST_COUNT)]
Workers = Annotated[Whole, Field(ge=1, le=1000)]
Seed = Annotated[Whole, Field(ge=0, le=MOST_SEED)]
PositiveFloat = Annotated[Real, Field(ge=1e-12, le=1e15)]
NonNegativeFloat = Annotated[Real, Field(ge=0.0, le=1e15)]
Coordinate = Annotated[Real, Field(ge=-1000.0, le=1000.0)]
Length = Annotated[Real, Field(ge=1e-6, le=1000.0)]
"""A size, length units (the domain's edge is 1)."""

Lengths3 = tuple[Length, Length, Length]


def _no_place(name: str) -> str:
    """Refuse the names that stand for the directory itself and the one above it."""
    if name in (".", ".."):
        raise ValueError("a name that a directory can have")
    return name


Name = Annotated[
    str,
    StringConstraints(min_length=1, max_length=100, pattern=r"^[^/\\\x00-\x1f\x7f]+$"),
    AfterValidator(_no_place),
]
"""A name that a directory is called after."""
