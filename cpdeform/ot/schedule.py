"""GeomLoss's default schedule at p = 1 in row chunks: its figures to rounding, without its dozen N x M matrices.

One averaged update of all four potentials at each temperature from the diameter down to the blur, then one last update that is
not averaged; see `geomloss.SamplesLoss` with ``backend="tensorized"``. Its distances are floored at 1e-4, which counts at
blurs near that: the self-terms see a point at 1e-4 from itself. Theirs are expanded into x^2 + y^2 - 2xy, ours are differences
of coordinates: the same in double precision, while in single precision theirs are off by some 3e-4 and not worth repeating.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import torch
from torch import Tensor

from cpdeform.ot.divergence import Problem, Side
from cpdeform.ot.softmin import scaled_exp_

FLOOR = 1e-8
"""Least squared distance, length units squared."""

_CHUNK_CPU = 1 << 16
_CHUNK_GPU = 1 << 24


def geomloss_blurs(diameter: float, blur: float, scaling: float) -> list[float]:
    """GeomLoss's temperatures for p = 1, length units: the diameter twice, then falling by `scaling`, then the blur.

    Points that are all one, with a diameter of zero, have the blur for it.
    """
    diameter = diameter or blur
    between = np.arange(np.log(diameter), np.log(blur), np.log(scaling))  # so that rounding gives as many as it does there
    return [diameter, *(float(value) for value in np.exp(between)), blur]


def geomloss_potentials(problem: Problem, *, blur: float, scaling: float, debias: bool) -> tuple[Tensor, Tensor, Tensor]:
    """Run the schedule.

    Args:
        problem: The clouds; its temperature is not used.
        blur: Final blur, length units.
        scaling: Ratio of successive blurs.
        debias: Whether to subtract the self-terms.

    Returns:
        Source potential (N,), target potential (M,), cost units; gradient (N, 3) of the source potential at each point with
        respect to that point.
    """
    source, target = problem.source, problem.target
    blurs = geomloss_blurs(problem.diameter(), blur, scaling)
    pairs = [(source, target), (target, source)] + ([(source, source), (target, target)] if debias else [])
    of = (1, 0, 2, 3)[: len(pairs)]  # whose potential each update takes: the cross terms take each other's
    potentials = [soft_minimum(here, there, torch.zeros_like(there.weights), blurs[0]) for here, there in pairs]
    for epsilon in blurs:
        updates = [soft_minimum(here, there, potentials[k], epsilon) for (here, there), k in zip(pairs, of, strict=True)]
        potentials = [0.5 * (old + new) for old, new in zip(potentials, updates, strict=True)]
    gradient = torch.zeros_like(source.points)
    for term, sign in ((0, 1.0), (2, -1.0)) if debias else ((0, 1.0),):
        here, there = pairs[term]
        gradient += sign * soft_minimum_gradient(here, there, potentials[of[term]], blurs[-1])
    last = [soft_minimum(here, there, potentials[k], blurs[-1]) for (here, there), k in zip(pairs, of, strict=True)]
    if debias:
        return last[0] - last[2], last[1] - last[3], gradient
    return last[0], last[1], gradient


def _rows(here: Side, there: Side) -> Iterator[slice]:
    """Slices of the rows; smaller than elsewhere, since double precision has to stay within the processor's cache."""
    step = max(1, (_CHUNK_CPU if here.points.device.type == "cpu" else _CHUNK_GPU) // len(there.points))
    for start in range(0, len(here.points), step):
        yield slice(start, min(start + step, len(here.points)))


def _exponents(points: Tensor, there: Side, potential: Tensor, epsilon: float) -> tuple[Tensor, Tensor]:
    """Costs (K, M) of points (K, 3), and (potential - cost) / epsilon + log weight."""
    cost = torch.cdist(points, there.points, compute_mode="donot_use_mm_for_euclid_dist").clamp_min_(math.sqrt(FLOOR))
    return cost, torch.add(there.log_weights + potential / epsilon, cost, alpha=-1.0 / epsilon)


def soft_minimum(here: Side, there: Side, potential: Tensor, epsilon: float) -> Tensor:
    """The potential (N,) at the points `here` from that (M,) on `there`."""
    result = torch.empty_like(here.weights)
    for rows in _rows(here, there):
        _, exponents = _exponents(here.points[rows], there, potential, epsilon)
        largest = exponents.amax(dim=1, keepdim=True)
        result[rows] = scaled_exp_(exponents.sub_(largest)).sum(dim=1).log_().add_(largest[:, 0]).mul_(-epsilon)
    return result


def soft_minimum_gradient(here: Side, there: Side, potential: Tensor, epsilon: float) -> Tensor:
    """Gradient (N, 3) of `soft_minimum` with respect to the points `here`; pairs at the floor have none."""
    result = torch.empty_like(here.points)
    for rows in _rows(here, there):
        cost, exponents = _exponents(here.points[rows], there, potential, epsilon)
        plan = torch.softmax(exponents, dim=1)
        plan = torch.where(cost > math.sqrt(FLOOR), plan / cost, 0.0)
        for axis in range(3):
            difference = here.points[rows, axis, None] - there.points[:, axis]
            result[rows, axis] = difference.mul_(plan).sum(dim=1)
    return result
