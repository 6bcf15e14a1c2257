"""The paper's ablation: a random point of the body's surface instead of the discovered contact point."""

from __future__ import annotations

import torch
from torch import Tensor

from cpdeform.core.errors import InputError
from cpdeform.core.placer import Placement, Placer, PlacerCapabilities, Stage
from cpdeform.placement.grid import GridOptions, ToolGrid, movable_manipulator

SURFACE_NEIGHBOURS = 48
SURFACE_OFFSET = 0.25
"""Offset of the neighbours' mean, in radii of their ball, from which a particle counts as on the surface. On a flat face it
is 3/8; inside a body sampled at random it is 0 with a standard deviation of 0.065 per axis, so 0.25 is hardly ever met."""


class PlacerRandom(Placer):
    """Places one tool at randomly drawn surface particles, touching, free of collision.

    Each candidate draws surface particles (see `surface_particles`) until the tool can be placed as near to one as
    collision allows, touching the body; its rotation is kept.

    Args:
        candidates: Number of placements.
        attempts: Particles drawn for one placement before it is given up.
        grid_size: Positions along each axis of every grid.
        refinements: Number of finer grids.
        clearance: Least distance between the tool and any particle, length units.
        margin: How far beyond touching the particle the first grid reaches, length units; see `PlacerTransport`.
        max_gap: Largest distance between tool and body beyond `clearance`, length units; None for any.

    Raises:
        InputError: An option is out of range.

    References:
        Li et al., "Contact Points Discovery for Soft-Body Manipulations with Differentiable Physics", ICLR 2022.
    """

    capabilities = PlacerCapabilities(needs_priorities=False, max_manipulators=1)

    def __init__(
        self,
        *,
        candidates: int = 1,
        attempts: int = 20,
        grid_size: int = 20,
        refinements: int = 2,
        clearance: float = 0.0,
        margin: float | None = None,
        max_gap: float | None = 0.0005,
    ) -> None:
        for name, number in (("candidates", candidates), ("attempts", attempts)):
            if number < 1:
                raise InputError(name, came=str(number), expected="at least 1")
        self.candidates, self.attempts = candidates, attempts
        self.options = GridOptions(
            grid_size=grid_size, refinements=refinements, clearance=clearance, margin=margin, max_gap=max_gap
        )

    def ask(self, stage: Stage) -> list[Placement]:
        """Propose `candidates` placements, fewer where no drawn particle can be touched.

        Raises:
            CapabilityError: The scene has not exactly one movable tool.
        """
        grid = ToolGrid(stage, movable_manipulator(stage), self.options)
        surface = surface_particles(grid.particles)
        placements = []
        for number in range(self.candidates):
            placement = self._draw(grid, surface, stage.generator, f"random-{number + 1}")
            if placement is not None:
                placements.append(placement)
        return placements

    def _draw(self, grid: ToolGrid, surface: Tensor, generator: torch.Generator, label: str) -> Placement | None:
        for _ in range(self.attempts):
            particle = int(surface[int(torch.randint(surface.shape[0], (1,), generator=generator))])
            point = grid.particles[particle]

            def gap(positions: Tensor, point: Tensor = point) -> Tensor:
                return grid.reduce(positions, point.unsqueeze(0), lambda distance: distance[:, 0])

            found = grid.search(point, gap)
            if found is not None:
                pose = grid.pose_at(found.position)
                return Placement(pose=pose, score=float("nan"), label=label, contact_particle=particle)
        return None


def surface_particles(positions: Tensor) -> Tensor:
    """Particles on the surface of a body: their nearest neighbours lie to one side.

    A particle counts where the mean of its 48 nearest neighbours (itself among them) is off by more than a quarter of the
    distance to the farthest of them.

    Args:
        positions: Particle positions (N, 3), length units.

    Returns:
        Indices (S,) of the surface particles on the CPU, ascending; of all particles where none stands out.
    """
    from scipy.spatial import cKDTree

    cloud = positions.detach().double().cpu()
    count = min(SURFACE_NEIGHBOURS, cloud.shape[0])
    distance, neighbours = cKDTree(cloud.numpy()).query(cloud.numpy(), k=range(1, count + 1))
    offset = (cloud[torch.as_tensor(neighbours)].mean(dim=1) - cloud).norm(dim=-1)
    surface = torch.nonzero(offset > SURFACE_OFFSET * torch.as_tensor(distance)[:, -1]).flatten()
    return surface if surface.numel() else torch.arange(cloud.shape[0])
