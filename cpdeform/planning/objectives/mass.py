"""Node masses of particle clouds: the quadratic B-spline scatter and its hand-written adjoint, in bounded memory."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from cpdeform.core.errors import InputError
from cpdeform.core.scene import Scene

STENCIL = 27
CHUNK_ENTRIES = 2**21
"""Stencil entries (particles times 27) handled at once; bounds the memory at about 50 MB."""


def mass_grid(positions: Tensor, scene: Scene) -> Tensor:
    """Mass of each grid node, with the simulator's quadratic B-spline weights; differentiable once.

    The stencil's base is x/dx - 0.5 truncated towards zero (PlasticineLab's quirk, where `floor` is meant): particles
    closer than dx/2 to a lower face of the domain use the stencil of the first cell, extrapolated. The weights still
    sum to 1 and reproduce the particle's position, so that mass and centre of mass are kept.

    Args:
        positions: Particle positions (..., N, 3), length units, in the domain [0, 1]^3.
        scene: Its `grid_size` G and `particle_volume` (mass of a particle) count.

    Returns:
        Node masses (..., G, G, G); node (i, j, k) lies at (i, j, k) / G.

    Raises:
        InputError: The shape is not (..., N, 3), or a position is outside the domain or not finite.
    """
    if positions.ndim < 2 or positions.shape[-1] != 3:
        raise InputError("positions", came=f"shape {tuple(positions.shape)}", expected="shape (..., particles, 3)")
    inside = (positions.detach() >= 0.0) & (positions.detach() <= 1.0)
    if not bool(inside.all()):
        count = int((~inside.all(dim=-1)).sum())
        raise InputError(
            "positions",
            came=f"{count} particles outside the domain or not finite",
            expected="coordinates in [0, 1]",
            remedy="Scale the shape into the domain, or look for the step at which the simulation diverged.",
        )
    size = scene.grid_size
    frames = positions.reshape(-1, positions.shape[-2], 3)
    masses: Tensor = _MassGrid.apply(frames, size)  # type: ignore[no-untyped-call]
    return scene.particle_volume * masses.reshape(*positions.shape[:-2], size, size, size)


def _stencil(points: Tensor, size: int) -> tuple[Tensor, Tensor, Tensor]:
    """Flat node indices (P, 27), weights (P, 3 axes, 3) and their slopes (P, 3, 3) per node distance of points (P, 3)."""
    scaled = points * size
    base = (scaled - 0.5).trunc().clamp(0, size - 3)
    offset = (scaled - base).unsqueeze(-1)
    weights = torch.cat([0.5 * (1.5 - offset) ** 2, 0.75 - (offset - 1.0) ** 2, 0.5 * (offset - 0.5) ** 2], dim=-1)
    slopes = torch.cat([offset - 1.5, 2.0 - 2.0 * offset, offset - 0.5], dim=-1)
    corner = base.long()
    first = (corner[:, 0] * size + corner[:, 1]) * size + corner[:, 2]
    axis = torch.arange(3, device=points.device)
    offsets = (axis[:, None, None] * size + axis[:, None]) * size + axis
    return first[:, None] + offsets.reshape(-1), weights, slopes


def _products(x: Tensor, y: Tensor, z: Tensor) -> Tensor:
    """Outer products (P, 27) of three rows of weights (P, 3)."""
    return (x[:, :, None, None] * y[:, None, :, None] * z[:, None, None, :]).reshape(-1, STENCIL)


def _chunks(frames: Tensor) -> list[tuple[int, slice]]:
    """Frame number and slice of particles of each piece of work."""
    step = CHUNK_ENTRIES // STENCIL
    return [(frame, slice(low, low + step)) for frame in range(frames.shape[0]) for low in range(0, frames.shape[1], step)]


class _MassGrid(torch.autograd.Function):
    """Number of particles per node; saves positions only, where autograd would save each of the 27 weights."""

    @staticmethod
    def forward(ctx: Any, frames: Tensor, size: int) -> Tensor:
        """Scatter frames (F, N, 3) into counts (F, size^3)."""
        ctx.save_for_backward(frames)
        ctx.size = size
        counts = frames.new_zeros(frames.shape[0], size**3)
        for frame, part in _chunks(frames):
            nodes, weights, _ = _stencil(frames[frame, part], size)
            counts[frame].scatter_add_(0, nodes.reshape(-1), _products(*weights.unbind(1)).reshape(-1))
        return counts

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None]:
        """Gather the gradient (F, size^3) of the counts into that of the positions."""
        (frames,), size = ctx.saved_tensors, ctx.size
        result = torch.empty_like(frames)
        for frame, part in _chunks(frames):
            nodes, weights, slopes = _stencil(frames[frame, part], size)
            values = grads[0][frame].index_select(0, nodes.reshape(-1)).reshape(nodes.shape)
            for axis in range(3):
                rows = [slopes[:, other] if other == axis else weights[:, other] for other in range(3)]
                result[frame, part, axis] = size * (_products(*rows) * values).sum(dim=1)
        return result, None
