"""The soft minimum between two point clouds, in row chunks, so that no N x M matrix is ever held.

With the cost c(x, y) = |x - y|^p, weights b of the points y and a potential g on them,

    f(x) = softmin(x; g) = -eps log sum_j b_j exp((g_j - c(x, y_j)) / eps),                                        (1)

the fixed points of f = softmin(g), g = softmin(f) are the entropic potentials relative to the product measure a (x) b [1]_.
Sums over float32 exponentials clamp their arguments: results in the denormal range cost ten times as much and add nothing.

References:
    .. [1] Peyré & Cuturi, "Computational Optimal Transport", Foundations and Trends in Machine Learning, 2019, section 4.
"""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

_CHUNK_CPU = 1 << 20  # pairs in a chunk: some arrays of this size stay within the processor's cache
_CHUNK_GPU = 1 << 25
_TINY_DISTANCE = 1e-30


def row_chunks(rows: int, columns: int, device: torch.device) -> Iterator[slice]:
    """Slices of the rows such that a chunk times `columns` entries stays small."""
    step = max(1, (_CHUNK_CPU if device.type == "cpu" else _CHUNK_GPU) // columns)
    for start in range(0, rows, step):
        yield slice(start, min(start + step, rows))


def pair_cost(source: Tensor, target: Tensor, exponent: int) -> Tensor:
    """Cost |x - y|^p of all pairs, (..., N, M) in units of length^p, from differences of coordinates.

    The expansion x^2 + y^2 - 2xy is faster, but in float32 its error, about 3e-4 in distance for coordinates near 1, is the
    size of a usual blur.
    """
    distance = torch.cdist(source, target, compute_mode="donot_use_mm_for_euclid_dist")
    return distance if exponent == 1 else distance.square_()


def scaled_exp_(values: Tensor) -> Tensor:
    """Exponential in place, with arguments clamped above the denormal range."""
    return values.clamp_min_(-80.0 if values.dtype == torch.float32 else -690.0).exp_()


def soft_minimum(
    source: Tensor, target: Tensor, log_weights: Tensor, potential: Tensor, *, epsilon: float, exponent: int
) -> Tensor:
    """Equation (1): the potential (N,) at the points `source` (N, 3) from that at `target` (M, 3).

    Args:
        source: Points where the result is wanted.
        target: Points that carry `potential`.
        log_weights: Logarithms (M,) of the weights of `target`; -inf where a weight is zero.
        potential: Potential (M,) on `target`, cost units.
        epsilon: Temperature, cost units.
        exponent: Power p of the distance.
    """
    offset = log_weights + potential / epsilon
    result = torch.empty_like(source[:, 0])
    for rows in row_chunks(source.shape[0], target.shape[0], source.device):
        exponents = pair_cost(source[rows], target, exponent).mul_(-1.0 / epsilon).add_(offset)
        largest = exponents.amax(dim=1, keepdim=True)
        result[rows] = scaled_exp_(exponents.sub_(largest)).sum(dim=1).log_().add_(largest[:, 0]).mul_(-epsilon)
    return result


def soft_minimum_gradient(
    source: Tensor, target: Tensor, log_weights: Tensor, potential: Tensor, *, epsilon: float, exponent: int
) -> tuple[Tensor, Tensor]:
    """Equation (1) and its gradient (N, 3) with respect to `source`.

    The gradient is sum_j P_ij grad c(x_i, y_j), with P_ij the terms of (1) normalised over j. A pair at distance zero
    contributes nothing: |x - y| has no gradient there, and zero is its symmetric subgradient.
    """
    offset = log_weights + potential / epsilon
    result = torch.empty_like(source[:, 0])
    gradient = torch.empty_like(source)
    for rows in row_chunks(source.shape[0], target.shape[0], source.device):
        cost = pair_cost(source[rows], target, exponent)
        exponents = torch.add(offset, cost, alpha=-1.0 / epsilon)
        largest = exponents.amax(dim=1, keepdim=True)
        plan = scaled_exp_(exponents.sub_(largest))
        total = plan.sum(dim=1)
        result[rows] = (total.log() + largest[:, 0]).mul_(-epsilon)
        plan = plan.div_(cost.clamp_min_(_TINY_DISTANCE)) if exponent == 1 else plan.mul_(2.0)
        for axis in range(3):  # differences first: sum(P) x - P y would lose the digits of close pairs
            difference = source[rows, axis, None] - target[:, axis]
            gradient[rows, axis] = difference.mul_(plan).sum(dim=1) / total
    return result, gradient
