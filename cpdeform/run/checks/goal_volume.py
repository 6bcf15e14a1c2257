"""A goal of more or less clay than there is."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cpdeform.run.checks.finding import Finding
from cpdeform.run.checks.occupancy import filled_volume, filling_radius

KIND = "goal volume"
MOST_DIFFERENCE = 0.15
"""Part of the clay's volume that the goal's may differ by. The estimates differ by up to a tenth between shapes of one volume (the
tasks that come with this package), and clay is compressible a little."""
LEAST_PARTICLES = 100
"""Fewer particles have no volume to speak of."""


def check_goal_volume(clay: NDArray[np.float64], goal: NDArray[np.float64]) -> list[Finding]:
    """Tell where the goal's volume is not the clay's: the loss never comes near zero, whatever the plan.

    Args:
        clay: Particles at the start (N, 3), length units.
        goal: Goal particles (M, 3), length units.
    """
    if min(len(clay), len(goal)) < LEAST_PARTICLES:
        return []
    radius = filling_radius(clay, goal)
    there, wanted = filled_volume(clay, radius), filled_volume(goal, radius)
    difference = wanted / there - 1.0
    if abs(difference) <= MOST_DIFFERENCE:
        return []
    return [
        Finding(
            "warning",
            KIND,
            "goal",
            f"The goal fills about {wanted:.3g} (in domain edges cubed), {abs(difference):.0%} "
            f"{'more' if difference > 0 else 'less'} than the clay's {there:.3g}; clay hardly changes its volume.",
            f"Scale the goal's lengths by {(1.0 / (1.0 + difference)) ** (1.0 / 3.0):.3g}, or change the bodies.",
        )
    ]
