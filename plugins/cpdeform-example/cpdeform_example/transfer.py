"""Transfers between particles and grid: MLS-MPM with quadratic B-splines.

All worlds share one list of nodes, those that any particle touches: a node is a world and a place. So nothing here or in
`grid.py` knows about the batch, and empty space costs nothing.

References:
    Hu et al., "A Moving Least Squares Material Point Method", SIGGRAPH 2018.
"""

from __future__ import annotations

import dataclasses
import itertools

import torch
from torch import Tensor


@dataclasses.dataclass(frozen=True)
class Stencil:
    """The 27 nodes around each particle.

    Attributes:
        weights: B-spline weights (B, N, 27).
        offsets: Node minus particle (B, N, 27, 3), in node distances.
        slots: Place (B, N, 27) of each node in the list of nodes.
        numbers: Numbers (K, 3) of the listed nodes along x, y, z.
        worlds: World (K,) of the listed nodes.
    """

    weights: Tensor
    offsets: Tensor
    slots: Tensor
    numbers: Tensor
    worlds: Tensor


def make_stencil(position: Tensor, grid_size: int) -> Stencil:
    """The stencil of particles at `position` (B, N, 3), length units, on a grid of `grid_size` nodes along each axis."""
    scaled = position * float(grid_size)
    # Truncation, not floor: a particle in the lowest half cell keeps a stencil that starts at node 0.
    base = (scaled.detach() - 0.5).nan_to_num().long().clamp(0, grid_size - 3)
    fraction = scaled - base
    # (B, N, 3 nodes, 3 axes)
    weights = torch.stack([0.5 * (1.5 - fraction) ** 2, 0.75 - (fraction - 1.0) ** 2, 0.5 * (fraction - 0.5) ** 2], dim=-2)
    corners = torch.tensor(list(itertools.product(range(3), repeat=3)), device=position.device)
    i, j, k = corners.unbind(-1)
    numbers = base.unsqueeze(-2) + corners
    worlds = torch.arange(len(position), device=position.device)[:, None, None, None].expand_as(numbers[..., :1])
    keys = _ravel(torch.cat([worlds, numbers], dim=-1), grid_size)
    listed, slots = torch.unique(keys, return_inverse=True)
    places = _unravel(listed, grid_size)
    return Stencil(
        weights=weights[..., i, 0] * weights[..., j, 1] * weights[..., k, 2],
        offsets=corners - fraction.unsqueeze(-2),
        slots=slots,
        numbers=places[:, 1:],
        worlds=places[:, 0],
    )


def _ravel(places: Tensor, size: int) -> Tensor:
    """One number for each (world, x, y, z)."""
    world, x, y, z = places.unbind(-1)
    return ((world * size + x) * size + y) * size + z


def _unravel(keys: Tensor, size: int) -> Tensor:
    """(world, x, y, z) of each number that `_ravel` made."""
    return torch.stack([keys // size**3, keys // size**2 % size, keys // size % size, keys % size], dim=-1)


def particles_to_grid(stencil: Stencil, momentum: Tensor, affine: Tensor, mass: float) -> tuple[Tensor, Tensor]:
    """Scatter momentum and mass.

    Args:
        stencil: The particles' stencils.
        momentum: Momentum of each particle (B, N, 3).
        affine: Momentum per node distance from the particle (B, N, 3, 3).
        mass: Mass of a particle.

    Returns:
        Momentum (K, 3) and mass (K,) of the listed nodes.
    """
    values = momentum.unsqueeze(-2) + stencil.offsets @ affine.mT
    values = stencil.weights.unsqueeze(-1) * torch.cat([values, torch.full_like(values[..., :1], mass)], dim=-1)
    grid = values.new_zeros(len(stencil.worlds), 4).index_add(0, stencil.slots.flatten(), values.flatten(0, 2))
    return grid[:, :3], grid[:, 3]


def grid_to_particles(stencil: Stencil, velocity: Tensor, grid_size: int) -> tuple[Tensor, Tensor]:
    """Gather the nodes' `velocity` (K, 3).

    Returns:
        Velocity (B, N, 3), length/second, and affine velocity field (B, N, 3, 3), 1/second, of the particles.
    """
    weighted = stencil.weights.unsqueeze(-1) * velocity[stencil.slots]
    return weighted.sum(dim=-2), 4.0 * grid_size * weighted.mT @ stencil.offsets
