"""What clay is made of."""

from __future__ import annotations

from pydantic import Field

from cpdeform.core.bounded import Real
from cpdeform.core.model import FrozenModel, PositiveFloat


class Material(FrozenModel):
    """Fixed-corotated elasticity with von Mises plasticity.

    Attributes:
        youngs_modulus: Young's modulus E, stress units (density 1, lengths in domain edges, seconds).
        poisson_ratio: Poisson's ratio nu, dimensionless, in (-1, 0.5).
        yield_stress: Von Mises yield stress, stress units.
    """

    youngs_modulus: PositiveFloat = 5000.0
    poisson_ratio: Real = Field(default=0.2, gt=-1.0, lt=0.5)
    yield_stress: PositiveFloat = 50.0

    @property
    def shear_modulus(self) -> float:
        """First Lame parameter mu = E / (2 (1 + nu)), stress units."""
        return self.youngs_modulus / (2.0 * (1.0 + self.poisson_ratio))

    @property
    def lame_lambda(self) -> float:
        """Second Lame parameter lambda = E nu / ((1 + nu)(1 - 2 nu)), stress units."""
        return self.youngs_modulus * self.poisson_ratio / ((1.0 + self.poisson_ratio) * (1.0 - 2.0 * self.poisson_ratio))
