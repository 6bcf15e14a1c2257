"""The base of the bodies' models."""

from __future__ import annotations

import abc

import numpy as np
from pydantic import Field

from cpdeform.core.bounded import MOST_PARTICLES, Whole
from cpdeform.core.material import Material
from cpdeform.core.model import FrozenModel, Vector3
from cpdeform.core.shapes.base import Array, RandomNumbers, Shape


class BodyBase(FrozenModel, abc.ABC):
    """A piece of clay, whose axes are the world's.

    Attributes:
        position: Centre, length units.
        particle_count: Number of particles sampled uniformly in the body.
        material: Material of this body; defaults to the scene's.
    """

    position: Vector3
    particle_count: Whole = Field(default=10000, gt=0, le=MOST_PARTICLES)
    material: Material | None = None

    @abc.abstractmethod
    def shape(self) -> Shape:
        """The solid that the body is at the start, around its centre."""

    @property
    @abc.abstractmethod
    def half_extents(self) -> Vector3:
        """Half of the bounding box's edges, length units."""

    @property
    def volume(self) -> float:
        """Volume at the start, cubic length units."""
        return self.shape().volume

    def sample(self, generator: RandomNumbers) -> Array:
        """Positions (`particle_count`, 3) of the body's particles, uniformly at random, length units."""
        return np.asarray(self.position, dtype=np.float64) + self.shape().sample(self.particle_count, generator)
