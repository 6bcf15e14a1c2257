"""Sinkhorn iterations to convergence on the pairs that matter, as sparse matrix-vector products.

At the small temperatures of transport priorities all but a few hundred partners of a point carry no mass. The kernel

    K_ij = exp((f_i + g_j - c_ij) / eps)                                                                            (1)

stabilised with the current potentials f, g [1]_, is kept where b_j K_ij or a_i K_ij exceeds exp(-cut). The iterations
u = 1 / K(b v), v = 1 / K'(a u) then cost microseconds instead of a pass over all pairs, and f + eps log u, g + eps log v
become the next potentials. Once these have moved further than the margin in `cut` allows, the pairs are selected anew; every
selection passes over all pairs, so a solution that it confirms is one of the full problem.

References:
    .. [1] Schmitzer, "Stabilized Sparse Scaling Algorithms for Entropy Regularized Transport Problems", SIAM J. Sci. Comput.,
       2019.
"""

from __future__ import annotations

import dataclasses
import math
import warnings

import torch
from torch import Tensor

from cpdeform.ot.divergence import Problem, Side, symmetric_update
from cpdeform.ot.softmin import pair_cost, row_chunks, scaled_exp_

_CUT = 13.0  # neglects exp(-13) = 2e-6 of a point's mass per pair
_MARGIN = 7.0  # eps units that a pair's f + g may grow before the selection is stale
_PAIR_LIMIT = 1 << 24  # pairs held sparsely; 256 MiB in float32 with the transpose
_DENSE_SMALL = 1 << 22  # pairs up to which selecting costs more than it saves
_DENSE_LIMIT = 1 << 27  # pairs up to which a kernel that is not sparse is held densely; 512 MiB in float32
_CHECK_EVERY = 10
_LEAST = 100  # iterations on a kernel: the marginals settle long before the potentials of weakly linked points do


@dataclasses.dataclass(frozen=True)
class Pairs:
    """Selected pairs in row order: row and column numbers (P,), cost (P,), and the order (P,) that sorts them by column."""

    rows: Tensor
    columns: Tensor
    cost: Tensor
    by_column: Tensor
    shape: tuple[int, int]

    def kernel(self, problem: Problem, source_potential: Tensor, target_potential: Tensor) -> tuple[Tensor, Tensor]:
        """Equation (1) as a sparse matrix (N, M), and its transpose."""
        exponents = source_potential[self.rows].add_(target_potential[self.columns]).sub_(self.cost).div_(problem.epsilon)
        values = exponents.clamp_(-80.0, 80.0).exp_()
        matrix = _compressed(self.rows, self.columns, values, self.shape)
        order = self.by_column
        return matrix, _compressed(self.columns[order], self.rows[order], values[order], (self.shape[1], self.shape[0]))


def _compressed(rows: Tensor, columns: Tensor, values: Tensor, shape: tuple[int, int]) -> Tensor:
    starts = torch.zeros(shape[0] + 1, dtype=torch.int32, device=rows.device)
    starts[1:] = torch.bincount(rows, minlength=shape[0]).cumsum(dim=0)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Sparse", category=UserWarning)  # PyTorch calls its CSR support beta
        return torch.sparse_csr_tensor(starts, columns.to(torch.int32), values, shape, check_invariants=False)


def select_pairs(problem: Problem, source_potential: Tensor, target_potentials: tuple[Tensor, Tensor]) -> Pairs | None:
    """Pairs that carry mass under the source potential with either target potential; None if they are too many.

    The first target potential makes the source marginal right and the second the target marginal, so that every row and
    every column keeps its largest entry.
    """
    source, target = problem.source, problem.target
    first, second = (potential / problem.epsilon + target.log_weights for potential in target_potentials)
    ceiling = torch.maximum(first, torch.maximum(second, second - target.log_weights + float(source.weights.max().log())))
    found: list[tuple[Tensor, Tensor, Tensor]] = []
    count = 0
    scaled = source_potential / problem.epsilon
    for rows in row_chunks(source.points.shape[0], target.points.shape[0], source.points.device):
        cost = pair_cost(source.points[rows], target.points, problem.exponent)
        exponents = torch.add(ceiling, cost, alpha=-1.0 / problem.epsilon).add_(scaled[rows, None])
        row, column = (exponents > -(_CUT + _MARGIN)).nonzero(as_tuple=True)
        count += row.numel()
        if count > _PAIR_LIMIT:
            return None
        found.append((row + rows.start, column, cost[row, column]))
    row, column, cost = (torch.cat(parts) for parts in zip(*found, strict=True))
    return Pairs(row, column, cost, torch.argsort(column, stable=True), (source.points.shape[0], target.points.shape[0]))


def _dense_kernel(problem: Problem, f: Tensor, g: Tensor) -> tuple[Tensor, Tensor]:
    source, target = problem.source.points, problem.target.points
    kernel = source.new_empty(source.shape[0], target.shape[0])
    for rows in row_chunks(source.shape[0], target.shape[0], source.device):
        exponents = pair_cost(source[rows], target, problem.exponent).neg_().add_(f[rows, None]).add_(g)
        kernel[rows] = scaled_exp_(exponents.div_(problem.epsilon).clamp_max_(80.0))
    return kernel, kernel.mT


def stabilised_kernel(problem: Problem, f: Tensor, targets: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor] | None:
    """Equation (1) with f and the second of `targets`, and its transpose, sparse or dense; None if neither fits in memory."""
    pairs = problem.source.points.shape[0] * problem.target.points.shape[0]
    if pairs > _DENSE_SMALL:
        selected = select_pairs(problem, f, targets)
        if selected is not None:
            return selected.kernel(problem, f, targets[1])
    return _dense_kernel(problem, f, targets[1]) if pairs <= _DENSE_LIMIT else None


def _iterate(problem: Problem, kernels: tuple[Tensor, Tensor], *, tolerance: float, limit: int) -> tuple[Tensor, Tensor, int]:
    """Iterate on fixed kernels until converged, out of iterations, or out of the selection's margin.

    Returns:
        The scalings u (N,) and v (M,) relative to the potentials within the kernels, and the iterations used.
    """
    kernel, transpose = kernels
    a, b = problem.source.weights, problem.target.weights
    u, v = torch.ones_like(a), torch.ones_like(b)
    smallest = torch.finfo(a.dtype).tiny * 16
    for count in range(1, limit + 1):
        previous = u
        u = (kernel @ (b * v)).clamp_min_(smallest).reciprocal_()
        v = (transpose @ (a * u)).clamp_min_(smallest).reciprocal_()
        if count % _CHECK_EVERY == 0:
            error = float((a * (previous / u - 1).abs()).sum())
            if (error < tolerance and count >= _LEAST) or float(u.max() * v.max()) > math.exp(_MARGIN):
                break
    return u, v, count


def descend(problem: Problem, f: Tensor, g: Tensor, *, tolerance: float, limit: int) -> tuple[Tensor, Tensor, int]:
    """Iterate at one temperature, building kernels anew until a pass over all pairs confirms the marginals.

    Args:
        problem: The clouds and the temperature.
        f: Source potential (N,) to start from, cost units.
        g: Target potential (M,) to start from, cost units.
        tolerance: L1 error of the source marginal to reach.
        limit: Most iterations.

    Returns:
        Both potentials, g being the update of an earlier f, and the iterations used.
    """
    used = 0
    while True:
        updated = problem.source_update(g)
        error = problem.source_error(f, updated)
        f = updated
        if used and (error <= tolerance or used >= limit):
            return f, g, used
        fresh = problem.target_update(f)
        kernels = stabilised_kernel(problem, f, (g, fresh))
        g = fresh
        used += 1
        if kernels is not None and used < limit:
            u, v, count = _iterate(problem, kernels, tolerance=0.5 * tolerance, limit=limit - used)
            f, g = f + problem.epsilon * u.log(), g + problem.epsilon * v.log()
            used += count


def self_potential(problem: Problem, side: Side, *, tolerance: float, limit: int = 200) -> Tensor:
    """Potential (N,) of the transport of `side` to itself, by averaged iterations (geometric means of the scalings).

    A self-problem needs no annealing: its two potentials are one, which removes the slow modes.

    Args:
        problem: Gives temperature and exponent.
        side: The cloud.
        tolerance: L1 error of the marginal to reach.
        limit: Most iterations.
    """
    itself = problem.self_problem(side)
    f = symmetric_update(itself, torch.zeros_like(side.weights))
    kernels = stabilised_kernel(itself, f, (f, f))
    if kernels is None:
        for _ in range(limit):
            updated = itself.source_update(f)
            error = itself.source_error(f, updated)
            f = 0.5 * (f + updated)
            if error < tolerance:
                break
        return f
    u = torch.ones_like(f)
    for _ in range(limit):
        product = kernels[0] @ (side.weights * u)
        error = float((side.weights * (u * product - 1).abs()).sum())
        u = (u / product).sqrt_()
        if error < tolerance:
            break
    return f + itself.epsilon * u.log()
