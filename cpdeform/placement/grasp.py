"""One or two tools on opposite sides of a body, facing each other through a contact point."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from cpdeform.core.clearance import exit_distances, tool_half_extents
from cpdeform.core.scene import Tool
from cpdeform.core.tool_surface import placed_surface
from cpdeform.placement.pose import turned

LATERAL_REACH = 0.9
"""Offsets aside of the contact point, in the tool's half widths: the tool still faces the point."""

TOOLS_PER_GRASP = 2
"""Tools that share a contact point; further ones take another one."""

Cost = Callable[[Tool, Tensor, Tensor], Tensor]
"""Maps a tool, its rotation (4,) and positions (G, 3) to what is to be minimised (G,)."""


@dataclasses.dataclass(frozen=True)
class Grasp:
    """A grasp that was found.

    Attributes:
        poses: Tool poses (M, 8), all tools of the scene.
        cost: Cost of the first tool's position, in the unit of the caller's cost.
    """

    poses: Tensor
    cost: float


@dataclasses.dataclass(frozen=True, kw_only=True)
class GraspSearch:
    """Search for the tools' positions along lines through a grid of points around the contact point.

    Attributes:
        tools: The scene's tools.
        particles: All particles (N, 3), length units.
        lines: Lines along each of the two axes across the direction.
        refinements: Number of finer grids of lines around the best one.
        clearance: Least distance between a tool and any particle or other tool, length units.
    """

    tools: Sequence[Tool]
    particles: Tensor
    lines: int = 5
    refinements: int = 2
    clearance: float = 0.0

    def find(
        self, poses: Tensor, indices: Sequence[int], obstacles: Sequence[int], contact: Tensor, direction: Tensor, cost: Cost
    ) -> Grasp | None:
        """Place the first tool where its cost is least, touching; the second one on the body's other side, on the same line.

        Args:
            poses: Poses (M, 8) of all tools, of which those of `indices` are replaced.
            indices: Indices of one or two tools.
            obstacles: Indices of tools that must not be touched.
            contact: Contact point (3,), length units.
            direction: Unit vector (3,) along a coordinate axis; the first tool may come from either end.
            cost: What the first tool's position is chosen by.

        Returns:
            The grasp; None where no line has room for all tools within their bounds.
        """
        points = torch.cat([self.particles, *(placed_surface(self.tools[index], poses[index]) for index in obstacles)])
        quaternions = [turned(self.tools[index], direction) for index in indices]
        half = tool_half_extents(self.tools[indices[0]], quaternions[0])
        across = torch.eye(3).to(direction)[direction.abs() < 0.5]
        reach = float((points.amax(0) - points.amin(0)).max()) + 2.0 * float(half.max())
        center, width = contact, LATERAL_REACH * (across @ half)
        lower, upper = self._bounds(indices, along=direction)
        best: Grasp | None = None
        for _ in range(self.refinements + 1):
            # A contact point beyond the tools' bounds is faced from as near as they get.
            starts = _lines(center, across, width, self.lines).clamp(lower, upper)
            found = [
                self._place(poses, indices, quaternions, starts, sign * direction, points, reach, cost) for sign in (1.0, -1.0)
            ]
            for grasp, start in (item for item in found if item is not None):
                if best is None or grasp.cost < best.cost:
                    best, center = grasp, start
            if best is None:
                return None
            width = width / (self.lines - 1)
        return best

    def _place(
        self,
        poses: Tensor,
        indices: Sequence[int],
        quaternions: Sequence[Tensor],
        starts: Tensor,
        direction: Tensor,
        points: Tensor,
        reach: float,
        cost: Cost,
    ) -> tuple[Grasp, Tensor] | None:
        """The best grasp with the first tool towards `direction`, and the start (3,) of its line."""
        placed: list[Tensor] = []
        for index, quaternion, sign in zip(indices, quaternions, (1.0, -1.0), strict=False):
            tool, heading = self.tools[index], sign * direction
            lengths = exit_distances(tool, quaternion, starts, heading, points, reach=reach, clearance=self.clearance)
            positions = starts + lengths.unsqueeze(-1) * heading
            lower, upper = positions.new_tensor(tool.lower_bound), positions.new_tensor(tool.upper_bound)
            inside = torch.isfinite(lengths) & (positions >= lower).all(dim=-1) & (positions <= upper).all(dim=-1)
            starts, placed = starts[inside], [earlier[inside] for earlier in placed]
            placed.append(positions[inside])
            if not starts.shape[0]:
                return None
        costs = cost(self.tools[indices[0]], quaternions[0], placed[0])
        chosen = int(costs.argmin())
        result = poses.clone()
        for index, quaternion, positions in zip(indices, quaternions, placed, strict=True):
            result[index, :3], result[index, 3:7] = positions[chosen], quaternion
        return Grasp(result, float(costs[chosen])), starts[chosen]

    def _bounds(self, indices: Sequence[int], *, along: Tensor) -> tuple[Tensor, Tensor]:
        """Corners (3,), (3,) that all of the tools stay between, without limits along a direction (3,)."""
        lower = along.new_tensor([self.tools[index].lower_bound for index in indices]).amax(dim=0)
        upper = along.new_tensor([self.tools[index].upper_bound for index in indices]).amin(dim=0)
        free = along.abs() > 0.5
        return lower.masked_fill(free, -torch.inf), upper.masked_fill(free, torch.inf)


def _lines(center: Tensor, across: Tensor, width: Tensor, count: int) -> Tensor:
    """Starts (count^2, 3) of lines spread `width` (2,) to either side of `center` (3,) along the axes `across` (2, 3)."""
    steps = torch.linspace(-1.0, 1.0, count).to(center)
    return center + (torch.cartesian_prod(steps, steps) * width) @ across
