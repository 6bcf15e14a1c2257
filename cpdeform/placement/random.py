"""The paper's ablation: a random point of the body's surface instead of the discovered contact point."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from cpdeform.core.clearance import reduce_distances
from cpdeform.core.errors import InputError
from cpdeform.core.placer import Candidate, Placer, PlacerCapabilities, Proposal, Stage
from cpdeform.core.scene import Tool, Vector3
from cpdeform.placement.grasp import TOOLS_PER_GRASP, GraspSearch
from cpdeform.placement.grid import GridOptions, ToolGrid, movable_tools
from cpdeform.placement.pose import GRASP_DIRECTIONS

SURFACE_NEIGHBOURS = 48
SURFACE_OFFSET = 0.25
"""Offset of the neighbours' mean, in radii of their ball, from which a particle counts as on the surface. On a flat face it
is 3/8; inside a body sampled at random it is 0 with a standard deviation of 0.065 per axis, so 0.25 is hardly ever met."""


class PlacerRandom(Placer):
    """Places the tools at randomly drawn surface particles, touching, free of collision.

    Each candidate draws surface particles (see `surface_particles`) until the tool can be placed as near to one as
    collision allows, touching the body; its rotation is kept. Several tools are placed in pairs that face each other through
    such a particle, along one of the three directions of `PlacerTransport`, drawn for each candidate. Where none of them lowers
    the loss, others are drawn.

    Args:
        candidates: Number of placements.
        draws: Particles drawn for one placement before it is given up.
        rounds: The most rounds of candidates in a stage.
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

    capabilities = PlacerCapabilities(needs_priorities=False, max_tools=None)

    def __init__(
        self,
        *,
        candidates: int = 1,
        draws: int = 20,
        rounds: int = 3,
        grid_size: int = 20,
        refinements: int = 2,
        clearance: float = 0.0,
        margin: float | None = None,
        max_gap: float | None = 0.0005,
    ) -> None:
        for name, number in (("candidates", candidates), ("draws", draws), ("rounds", rounds)):
            if number < 1:
                raise InputError(name, came=str(number), expected="at least 1")
        self.candidates, self.draws, self.rounds = candidates, draws, rounds
        self._stage: Stage | None = None
        self._round = 0
        self.options = GridOptions(
            grid_size=grid_size, refinements=refinements, clearance=clearance, margin=margin, max_gap=max_gap
        )

    def expected_proposals(self, movable: int) -> tuple[int, int]:
        """See `Placer`."""
        return self.candidates, self.rounds

    def ask(self, stage: Stage) -> list[Proposal]:
        """Propose `candidates` placements, fewer where no drawn particle can be touched.

        Raises:
            CapabilityError: The scene has no movable tool.
        """
        if stage is not self._stage:
            self._stage, self._round = stage, 0
        self._round += 1
        movable = movable_tools(stage)
        surface = surface_particles(stage.state.position[0].detach())
        placements = []
        for number in range(self.candidates):
            label = f"random-{number + 1}"
            if len(movable) == 1:
                placement = self._draw(ToolGrid(stage, movable[0], self.options), surface, stage.generator, label)
            else:
                placement = self._draw_grasps(stage, movable, surface, label)
            if placement is not None:
                placements.append(placement)
        return placements

    def tell(self, results: list[Candidate]) -> bool:
        """Ask again as long as nothing lowered the loss and rounds are left."""
        stage = self._stage
        if stage is None:
            return False
        return all(not result.loss < stage.loss for result in results) and self._round < self.rounds

    def _draw_grasps(self, stage: Stage, movable: Sequence[int], surface: Tensor, label: str) -> Proposal | None:
        particles = stage.state.position[0].detach()
        search = GraspSearch(tools=stage.scene.tools, particles=particles, clearance=self.options.clearance)
        poses, first = stage.state.tool_pose[0].detach().clone(), None
        placed = [index for index in range(len(stage.scene.tools)) if index not in movable]
        for start in range(0, len(movable), TOOLS_PER_GRASP):
            tools = movable[start : start + TOOLS_PER_GRASP]
            grasp = None
            for _ in range(self.draws):
                particle = _draw_one(surface, stage.generator)
                direction = torch.tensor(_draw_direction(stage.generator)).to(particles)
                point = particles[particle]

                def gap(tool: Tool, quaternion: Tensor, positions: Tensor, point: Tensor = point) -> Tensor:
                    return reduce_distances(tool, quaternion, positions, point.unsqueeze(0), lambda distance: distance[:, 0])

                grasp = search.find(poses, tools, placed, point, direction, gap)
                if grasp is not None:
                    break
            if grasp is None:
                return None
            poses, placed, first = grasp.poses, [*placed, *tools], particle if first is None else first
        return Proposal(pose=poses, score=float("nan"), label=label, contact_particle=first)

    def _draw(self, grid: ToolGrid, surface: Tensor, generator: torch.Generator, label: str) -> Proposal | None:
        for _ in range(self.draws):
            particle = _draw_one(surface, generator)
            point = grid.particles[particle]

            def gap(positions: Tensor, point: Tensor = point) -> Tensor:
                return grid.reduce(positions, point.unsqueeze(0), lambda distance: distance[:, 0])

            found = grid.search(point, gap)
            if found is not None:
                pose = grid.pose_at(found.position)
                return Proposal(pose=pose, score=float("nan"), label=label, contact_particle=particle)
        return None


def _draw_one(surface: Tensor, generator: torch.Generator) -> int:
    return int(surface[int(torch.randint(surface.shape[0], (1,), generator=generator))])


def _draw_direction(generator: torch.Generator) -> Vector3:
    directions = list(GRASP_DIRECTIONS.values())
    return directions[int(torch.randint(len(directions), (1,), generator=generator))]


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
