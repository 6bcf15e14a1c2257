"""From a coarse subset at a wide blur to all points at the final one, carrying debiased potentials.

A direct Sinkhorn descent at a small temperature does not converge, so the temperature is lowered step by step, each step
starting from the last (epsilon scaling [1]_). What is carried matters. The raw potential holds an entropic offset that
depends on the local density and on the temperature; started from the last temperature's, it has to be relearnt point by
point, and where points touch only their own copies in the target those modes decay like exp(-spacing / eps) per iteration:
they freeze as noise far from any deformation. The debiased potentials F = f_xy - f_xx, G = g_xy - g_yy hardly depend on the
temperature, and the self-potentials converge in a few iterations at any. So a step starts from

    f = F + f_xx(eps),  g = G + g_yy(eps),                                                                          (1)

which is already a fixed point wherever the two clouds agree. The same holds from a subset of the points to all of them.

References:
    .. [1] Schmitzer, "Stabilized Sparse Scaling Algorithms for Entropy Regularized Transport Problems", SIAM J. Sci. Comput.,
       2019.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import torch
from torch import Tensor

from cpdeform.ot.divergence import Potentials, Problem, Side
from cpdeform.ot.sparse import self_potential

Descent = Callable[[Problem, Tensor, Tensor, float, int], tuple[Tensor, Tensor, int]]
"""Solves at one temperature: (problem, f, g, tolerance, most iterations) -> f, g and the iterations used."""

Start = Callable[[Problem], tuple[Tensor, Tensor]]
"""Debiased potentials (N,), (M,) of a problem at a wide blur."""

_COARSE_POINTS = 2000
_COARSE_BLUR = 0.01  # of the diameter: about the point spacing of the subset
_LOOSE = 10.0  # tolerance of the steps before the last, as a multiple of the last one's


@dataclasses.dataclass(frozen=True)
class Schedule:
    """How to anneal.

    Attributes:
        start: Blur of the first temperature, as a fraction of the diameter.
        scaling: Ratio of a blur to the one before it.
        tolerance: L1 error of the source marginal at the final temperature.
        iterations: Most iterations at any one temperature.
    """

    start: float
    scaling: float
    tolerance: float
    iterations: int

    def blurs(self, first: float, last: float) -> list[float]:
        """Geometric sequence from `first` down to exactly `last`, with ratios of about `scaling`."""
        steps = round(math.log(last / first) / math.log(self.scaling)) if first > last else 0
        steps = max(steps, 1 if first > last * 1.001 else 0)
        return [last * (first / last) ** (1 - step / steps) for step in range(steps)] + [last]


def solve_cold(problem: Problem, schedule: Schedule, start: Start, descent: Descent) -> tuple[Potentials, int]:
    """Anneal without previous potentials.

    Args:
        problem: The clouds and the final temperature.
        schedule: Temperatures and tolerances.
        start: Gives the first debiased potentials, at the first temperature.
        descent: Solves at one temperature.

    Returns:
        Potentials at the final temperature (self-potentials always included), and the iterations at it.
    """
    diameter, blur = problem.diameter(), problem.epsilon ** (1 / problem.exponent)
    first, coarse = max(blur, schedule.start * diameter), max(blur, _COARSE_BLUR * diameter)
    subset = _subset(problem)
    source, target = start(subset.at(first**problem.exponent))
    if subset is not problem:
        potentials, _ = _ladder(subset, source, target, schedule.blurs(first, coarse), schedule, descent, final=False)
        source, target = _extend(subset.at(coarse**problem.exponent), problem, potentials)
        first = coarse
    return _ladder(problem, source, target, schedule.blurs(first, blur), schedule, descent, final=True)


def _ladder(
    problem: Problem, source: Tensor, target: Tensor, blurs: list[float], schedule: Schedule, descent: Descent, *, final: bool
) -> tuple[Potentials, int]:
    """Descend through `blurs` from debiased potentials, equation (1)."""
    for step, blur in enumerate(blurs):
        last = final and step == len(blurs) - 1
        tolerance = schedule.tolerance if last else min(0.05, _LOOSE * schedule.tolerance)
        current = problem.at(blur**problem.exponent)
        source_self = self_potential(current, problem.source, tolerance=0.01 * tolerance)
        target_self = self_potential(current, problem.target, tolerance=0.01 * tolerance)
        f, g, used = descent(current, source + source_self, target + target_self, tolerance, schedule.iterations)
        source, target = f - source_self, g - target_self
    return Potentials(f, g, source_self, target_self, problem.target), used


def _subset(problem: Problem) -> Problem:
    """At most 2000 evenly strided points of each cloud, those of equal number where the clouds are of equal size.

    The same numbers keep a point and its copy in the target together, so that the subset agrees where the clouds do.
    """
    if max(problem.source.points.shape[0], problem.target.points.shape[0]) <= _COARSE_POINTS:
        return problem

    def thin(side: Side) -> Side:
        count = side.points.shape[0]
        if count <= _COARSE_POINTS:
            return side
        return side.subset(torch.arange(_COARSE_POINTS, device=side.points.device) * count // _COARSE_POINTS)

    return dataclasses.replace(problem, source=thin(problem.source), target=thin(problem.target))


def _extend(coarse: Problem, fine: Problem, potentials: Potentials) -> tuple[Tensor, Tensor]:
    """Debiased potentials of `coarse`, evaluated at the points of `fine` by the soft minima that define them."""
    source_self, target_self = potentials.source_self, potentials.target_self
    if source_self is None or target_self is None:
        raise ValueError("extending debiased potentials needs the self-potentials")
    to_source = dataclasses.replace(coarse, source=fine.source)
    to_target = dataclasses.replace(coarse, source=fine.target)
    f = to_source.source_update(potentials.target)
    f -= dataclasses.replace(to_source, target=coarse.source).source_update(source_self)
    g = dataclasses.replace(to_target, target=coarse.source).source_update(potentials.source)
    g -= to_target.source_update(target_self)
    return f, g
