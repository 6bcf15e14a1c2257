"""The paper's placer: the tool goes where the body has to move most."""

from __future__ import annotations

import torch
from torch import Tensor

from cpdeform.core.errors import InputError
from cpdeform.core.placer import Placement, Placer, PlacerCapabilities, Stage
from cpdeform.placement.grid import GridOptions, ToolGrid, movable_manipulator


class PlacerTransport(Placer):
    """Places one tool around the particle of largest transport priority, free of collision, where its score is highest.

    With priorities f_i and the distance d_i(x) of particle i to the surface of the tool at position x, the score is
    1/N sum_i f_i / (d_i(x)^2 + 1), maximised over a grid of positions x around that particle and then over finer grids
    around the best. Distances count in units of `distance_scale`. With a scale of 1, the domain's edge, d^2 << 1 for every
    particle: the score is flat, far particles' small priorities outweigh the tool's neighbourhood, and on a board with one
    stroke the tool lands in a corner of the grid. The default, a tool's radius, makes the neighbourhood count.

    The score depends on the gauge of the priorities, which is fixed by `OTResult`: zero weighted median.

    Args:
        grid_size: Positions along each axis of every grid (the paper: 20).
        refinements: Number of finer grids. A tool acts on the clay only within about 0.0035 of its surface, less than the
            first grid's spacing: without refinement the plan's gradient may be zero.
        clearance: Least distance between the tool and any particle, length units.
        margin: How far beyond touching the particle the first grid reaches, length units; half of the tool's smallest half
            extent where absent.
        distance_scale: Length that the score measures distances in; 1 is the paper's formula to the letter.
        max_gap: Largest distance between tool and body beyond `clearance`, length units. The paper leaves this to the
            score, which pushes the tool off the body where priorities are negative; None does the same.

    Raises:
        InputError: An option is out of range.

    References:
        Li et al., "Contact Points Discovery for Soft-Body Manipulations with Differentiable Physics", ICLR 2022, section
        "Direct Single Manipulator Placement".
    """

    capabilities = PlacerCapabilities(needs_priorities=True, max_manipulators=1)

    def __init__(
        self,
        *,
        grid_size: int = 20,
        refinements: int = 2,
        clearance: float = 0.0,
        margin: float | None = None,
        distance_scale: float = 0.03,
        max_gap: float | None = 0.0005,
    ) -> None:
        if not 0.0 < distance_scale < float("inf"):
            raise InputError("distance_scale", came=str(distance_scale), expected="a finite number above 0")
        self.options = GridOptions(
            grid_size=grid_size, refinements=refinements, clearance=clearance, margin=margin, max_gap=max_gap
        )
        self.distance_scale = distance_scale

    def ask(self, stage: Stage) -> list[Placement]:
        """Propose one placement of the only movable tool; its rotation is kept.

        Returns:
            One placement; none where every position around the particle collides, is out of the tool's bounds or does not touch.

        Raises:
            CapabilityError: The scene has not exactly one movable tool.
            InputError: The priorities are not finite, or do not fit the particles.
        """
        grid = ToolGrid(stage, movable_manipulator(stage), self.options)
        priorities = stage.priorities.detach().to(grid.particles)
        if priorities.shape != grid.particles.shape[:1] or not bool(torch.isfinite(priorities).all()):
            raise InputError(
                "stage.priorities",
                came=f"shape {tuple(priorities.shape)}, {int((~torch.isfinite(priorities)).sum())} not finite",
                expected=f"{grid.particles.shape[0]} finite priorities",
            )
        contact = int(priorities.argmax())
        weighted = priorities != 0.0
        particles, weights = grid.particles[weighted], priorities[weighted] / priorities.shape[0]

        def penalty(positions: Tensor) -> Tensor:
            return grid.reduce(positions, particles, lambda distance: score_loss(distance, weights, self.distance_scale))

        noise = 4.0 * torch.finfo(weights.dtype).eps * float(weights.abs().sum()) * float(grid.half_extents.max()) ** 2
        found = grid.search(grid.particles[contact], penalty, tolerance=noise)
        if found is None:
            return []
        score = float(priorities.double().mean()) - found.cost
        return [Placement(pose=grid.pose_at(found.position), score=score, label="direct", contact_particle=contact)]


def score_loss(distance: Tensor, weights: Tensor, distance_scale: float = 1.0) -> Tensor:
    """What the score loses against a tool that touches every particle: sum_i w_i - sum_i w_i / (d_i^2 + 1).

    The score itself differs between positions only in its last digits, since d_i^2 is small beside 1; this form keeps them.

    Args:
        distance: Distances (..., P), length units.
        weights: Priorities over the number of particles (P,).
        distance_scale: Length that distances are measured in.

    Returns:
        Lost score (...), in the unit of `weights`.
    """
    squared = (distance / distance_scale) ** 2 if distance_scale != 1.0 else distance * distance
    return (squared / (squared + 1.0)) @ weights
