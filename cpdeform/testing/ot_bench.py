"""Point clouds on which transport solvers are checked."""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from cpdeform.core.ot import OTResult, OTSolver

STROKE = torch.tensor([[0.45, 0.1, 0.55], [0.5, 0.1, 0.6]], dtype=torch.float64)
STROKE_RADIUS = 0.03


@dataclasses.dataclass(frozen=True)
class OTBench:
    """A solver under test, on small clouds, in double precision.

    Attributes:
        solver: The solver.
        result: Its result for `source`, `target` and `source_weights`.
        source: Source points (N, 3), length units.
        target: Target points (M, 3), length units.
        source_weights: Weights (N,).
    """

    solver: OTSolver
    source: Tensor
    target: Tensor
    source_weights: Tensor
    result: OTResult


def make_bench(solver: OTSolver) -> OTBench:
    """Solve one problem, whose result several checks look at."""
    source, target, weights = cloud(60, seed=13), cloud(50, seed=14) + 0.04, random_weights(60, seed=1)
    return OTBench(solver, source, target, weights, solver.solve(source, target, source_weights=weights))


def cloud(count: int, *, seed: int) -> Tensor:
    """Random points (count, 3) of a board, 0.3 x 0.1 x 0.3 around (0.5, 0.05, 0.5)."""
    generator = torch.Generator().manual_seed(seed)
    points = torch.rand(count, 3, generator=generator, dtype=torch.float64)
    return points * torch.tensor([0.3, 0.1, 0.3], dtype=torch.float64) + torch.tensor([0.35, 0.0, 0.35], dtype=torch.float64)


def lattice(size: int, spacing: float) -> Tensor:
    """Points (size^3, 3) of a cubic lattice."""
    axis = spacing * torch.arange(size, dtype=torch.float64)
    return torch.cartesian_prod(axis, axis, axis)


def random_weights(count: int, *, seed: int) -> Tensor:
    """Random positive weights (count,) that sum to 1."""
    weights = 0.2 + torch.rand(count, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return weights / weights.sum()


def stroke_offset(points: Tensor) -> Tensor:
    """Vectors (N, 3) from the nearest point of the pen's stroke."""
    start, axis = STROKE[0], STROKE[1] - STROKE[0]
    along = ((points - start) @ axis / (axis @ axis)).clamp(0.0, 1.0)
    offset: Tensor = points - start - along[:, None] * axis
    return offset


def pressed(points: Tensor) -> Tensor:
    """The points after a pen's stroke: those near it pushed down and aside by at most 12 mm, all others exactly as they were."""
    offset = stroke_offset(points)
    distance = offset.norm(dim=1)
    push = 0.4 * STROKE_RADIUS * (1.0 - distance / (1.6 * STROKE_RADIUS)).clamp(min=0.0)
    direction = offset / distance.clamp_min(1e-9)[:, None]
    direction[:, 1] = -direction[:, 1].abs()
    moved: Tensor = points + push[:, None] * direction
    return moved


def cosine(first: Tensor, second: Tensor) -> float:
    """Cosine of the angle between two gradients."""
    return float(torch.nn.functional.cosine_similarity(first.double().flatten(), second.double().flatten(), dim=0))
