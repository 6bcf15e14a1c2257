"""What proposers look at: a stage, what has been tried in it, and the paper's score."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import torch
from torch import Tensor

from cpdeform.core.clearance import reduce_distances, tool_half_extents
from cpdeform.core.scene import Tool
from cpdeform.placement.grasp import Cost
from cpdeform.placement.grid import GridOptions, ToolGrid
from cpdeform.placement.priorities import Exploration


@dataclasses.dataclass(frozen=True, kw_only=True)
class ContactSearch:
    """The search for contacts in a stage.

    Attributes:
        exploration: The stage, its priorities, and the particles that have been tried.
        movable: Indices of the movable tools.
        options: How finely a single tool's position is searched, and how near to the body it may be.
        distance_scale: Length that the score measures distances in.
    """

    exploration: Exploration
    movable: tuple[int, ...]
    options: GridOptions
    distance_scale: float

    @property
    def particles(self) -> Tensor:
        """All particles (N, 3), length units."""
        return self.exploration.stage.state.position[0].detach()

    @property
    def poses(self) -> Tensor:
        """A copy of the tools' poses (M, 8) at the stage's start."""
        return self.exploration.stage.state.tool_pose[0].detach().clone()

    @property
    def fixed(self) -> list[int]:
        """Indices of the tools that do not move."""
        return [index for index in range(len(self.exploration.stage.scene.tools)) if index not in self.movable]

    def cost(self) -> Cost:
        """What the score loses, for tools at given positions."""
        priorities = self.exploration.priorities
        weighted = priorities != 0.0
        points, weights = self.particles[weighted], priorities[weighted] / priorities.shape[0]

        def cost(tool: Tool, quaternion: Tensor, positions: Tensor) -> Tensor:
            return reduce_distances(
                tool, quaternion, positions, points, lambda distance: score_loss(distance, weights, self.distance_scale)
            )

        return cost

    def score(self, cost: float) -> float:
        """The paper's score of a place with this cost."""
        return float(self.exploration.priorities.double().mean()) - cost

    def best_position(self, grid: ToolGrid, contact: int) -> tuple[Tensor, float] | None:
        """Poses (M, 8) with the grid's tool at its best position around a particle, and the cost there; None for no room."""
        cost, weights = self.cost(), self.exploration.priorities / self.exploration.priorities.shape[0]
        noise = 4.0 * torch.finfo(weights.dtype).eps * float(weights.abs().sum()) * float(grid.half_extents.max()) ** 2
        found = grid.search(grid.particles[contact], lambda positions: cost(grid.tool, grid.quaternion, positions), tolerance=noise)
        return None if found is None else (grid.pose_at(found.position), found.cost)

    def contacts(self, contact: int) -> Iterator[int]:
        """The contact point, then that of the next body in the ranking and so on; on each body away from those before."""
        exploration, ranking = self.exploration, self.exploration.ranking
        widest = max(half_width(tool, widest=True) for tool in exploration.stage.scene.tools if tool.movable)
        taken = exploration.near(contact, 2.0 * widest)
        yield contact
        number, empty = ranking.index(int(exploration.bodies[contact])), 0
        while empty < len(ranking):
            number += 1
            following = exploration.contact(ranking[number % len(ranking)], excluded=taken)
            empty = empty + 1 if following is None else 0
            if following is not None:
                taken |= exploration.near(following, 2.0 * widest)
                yield following


def half_width(tool: Tool, *, widest: bool = False) -> float:
    """Half of a tool's smallest or largest width, length units."""
    half = tool_half_extents(tool, torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=torch.float64))
    return float(half.max() if widest else half.min())


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
