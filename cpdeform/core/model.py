"""The base of all data models, and the types of their fields."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict

from cpdeform.core.bounded import Coordinate, NonNegativeFloat, PositiveFloat, Real

__all__ = ["FrozenModel", "NonNegativeFloat", "PositiveFloat", "Quaternion", "Vector3"]

Vector3 = tuple[Coordinate, Coordinate, Coordinate]
Quaternion = tuple[Real, Real, Real, Real]


class FrozenModel(BaseModel):
    """Base of all data models: immutable, no unknown fields, no infinities."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)
