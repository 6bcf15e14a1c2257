"""Search for a tool's position on a grid around a contact point, refined around the best, free of collision."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from cpdeform.core.clearance import CHUNK_DISTANCES, reduce_distances, smallest_gaps, tool_half_extents
from cpdeform.core.errors import CapabilityError, InputError
from cpdeform.core.placer import Stage
from cpdeform.core.rotation import rotate
from cpdeform.core.scene import Tool
from cpdeform.core.signed_distance import signed_distance
from cpdeform.core.tool_surface import placed_surface, surface_points


@dataclasses.dataclass(frozen=True)
class GridOptions:
    """How finely to search.

    Attributes:
        grid_size: Positions along each axis of every grid.
        refinements: Number of finer grids after the first; each spans the widest spacing of the grid before to either side.
        clearance: Least distance between the tool's surface and any particle or fixed tool, length units.
        margin: How far beyond touching the contact point the first grid reaches, length units; defaults to half of the
            tool's smallest half extent.
        max_gap: Largest distance, beyond `clearance`, between the tool and the nearest particle, length units; grids of a
            wider spacing allow that spacing. None allows any. A tool acts on the clay only within about 0.0035.

    Raises:
        InputError: A number is out of range.
    """

    grid_size: int = 20
    refinements: int = 2
    clearance: float = 0.0
    margin: float | None = None
    max_gap: float | None = 0.0005

    def __post_init__(self) -> None:
        limits = {"grid_size": (self.grid_size, 2), "refinements": (self.refinements, 0), "clearance": (self.clearance, 0.0)}
        for name, number in (("margin", self.margin), ("max_gap", self.max_gap)):
            if number is not None:
                limits[name] = (number, 0.0)
        for name, (value, least) in limits.items():
            if not least <= value < float("inf"):
                raise InputError(name, came=str(value), expected=f"a finite number of at least {least}")


@dataclasses.dataclass(frozen=True)
class GridResult:
    """The best position found.

    Attributes:
        position: Position (3,) of the tool's origin, length units.
        cost: What the search minimised, in the unit of the caller's cost.
    """

    position: Tensor
    cost: float


def movable_tools(stage: Stage) -> list[int]:
    """Indices of the scene's movable tools.

    Raises:
        CapabilityError: The scene has none.
    """
    movable = [index for index, tool in enumerate(stage.scene.tools) if tool.movable]
    if not movable:
        raise CapabilityError("The scene has no movable tool to be placed; give one a positive action_scale.")
    return movable


class ToolGrid:
    """All that stays the same while one tool, its rotation kept, is tried at many positions.

    Args:
        stage: Body, tools and bounds.
        index: Which tool is moved.
        options: How finely to search.
        poses: Poses (M, 8) of all tools; defaults to those of the state.
        obstacles: Indices of the tools that must not be touched; defaults to all others.

    Raises:
        InputError: The stage's state holds several worlds.
    """

    def __init__(
        self,
        stage: Stage,
        index: int,
        options: GridOptions,
        *,
        poses: Tensor | None = None,
        obstacles: Sequence[int] | None = None,
    ) -> None:
        if stage.state.batch_size != 1:
            raise InputError("stage.state", came=f"{stage.state.batch_size} worlds", expected="a single world")
        self.options = options
        self.tool: Tool = stage.scene.tools[index]
        self.particles = stage.state.position[0].detach()
        poses = stage.state.tool_pose[0].detach() if poses is None else poses
        self.index, self.poses, self.quaternion = index, poses, poses[index, 3:7]
        self.half_extents = tool_half_extents(self.tool, self.quaternion)
        self._lower = poses.new_tensor(self.tool.lower_bound)
        self._upper = poses.new_tensor(self.tool.upper_bound)
        self._surface = surface_points(self.tool).to(poses)
        others = [other for other in range(len(stage.scene.tools)) if other != index] if obstacles is None else obstacles
        self._fixed = [(stage.scene.tools[other], poses[other]) for other in others]
        clouds = [placed_surface(tool, pose) for tool, pose in self._fixed]
        self._obstacles = torch.cat(clouds) if clouds else self.particles[:0]

    def pose_at(self, position: Tensor) -> Tensor:
        """Poses (M, 8) of all tools with this one at `position` (3,)."""
        poses = self.poses.clone()
        poses[self.index, :3] = position
        return poses

    def reduce(self, positions: Tensor, points: Tensor, reduction: Callable[[Tensor], Tensor]) -> Tensor:
        """Reduce the distances of points to the tool at each position, in bounded memory.

        Args:
            positions: Tool positions (G, 3), length units.
            points: Points (P, 3), length units.
            reduction: Maps distances (g, P) of a piece of the positions to numbers (g,).

        Returns:
            Numbers (G,).
        """
        return reduce_distances(self.tool, self.quaternion, positions, points, reduction)

    def smallest_gap(self, position: Tensor) -> float:
        """Distance between the tool's surface at `position` (3,) and the nearest particle, length units."""
        return float(self.reduce(position.unsqueeze(0), self.particles, lambda distance: distance.amin(dim=-1))[0])

    def feasible(self, positions: Tensor, *, largest_gap: float = float("inf")) -> Tensor:
        """Select positions within the tool's bounds and free of collision.

        Args:
            positions: Tool positions (G, 3), length units.
            largest_gap: Positions with a larger distance between tool and body are left out, length units.

        Returns:
            The positions that remain (F, 3), in their order.
        """
        inside = ((positions >= self._lower) & (positions <= self._upper)).all(dim=-1)
        positions = positions[inside]
        gaps = self._gaps(positions, self.particles, largest_gap if largest_gap < float("inf") else 0.0)
        positions = positions[(gaps >= self.options.clearance) & (gaps <= largest_gap)]
        positions = positions[self._gaps(positions, self._obstacles) >= self.options.clearance]
        # The other tools' surfaces were obstacles above; a tool that is wholly inside another shows only the other way round.
        for tool, pose in self._fixed:
            positions = positions[self._gaps_to_tool(positions, tool, pose) >= self.options.clearance]
        return positions

    def _gaps_to_tool(self, positions: Tensor, other: Tool, pose: Tensor) -> Tensor:
        """Least distance (G,) of this tool's surface to another tool, negative where it reaches inside."""
        surface = rotate(self.quaternion, self._surface)
        step = max(1, CHUNK_DISTANCES // surface.shape[0])
        chunks = torch.split(positions, step)
        return torch.cat([signed_distance(other, pose, surface + chunk.unsqueeze(1)).amin(dim=-1) for chunk in chunks])

    def _gaps(self, positions: Tensor, points: Tensor, reach: float = 0.0) -> Tensor:
        """Distance (G,) between the tool and the nearest of the points (P, 3); exact up to `reach` or the clearance."""
        reach = max(reach, self.options.clearance)
        return smallest_gaps(self.tool, self.quaternion, positions, points, reach=reach)

    def search(self, contact: Tensor, cost: Callable[[Tensor], Tensor], *, tolerance: float = 0.0) -> GridResult | None:
        """Find the feasible position of lowest cost around a contact point.

        Args:
            contact: Contact point (3,) that the first grid is centred at, length units.
            cost: Maps feasible positions (F, 3) to costs (F,).
            tolerance: Costs that differ by less are ties; of these the position nearest to touching `contact` is taken.

        Returns:
            The best position; None where a grid has no feasible one.
        """
        margin = self.options.margin if self.options.margin is not None else 0.5 * float(self.half_extents.min())
        half = self.half_extents + margin + self.options.clearance
        center, best = contact, None
        for _ in range(self.options.refinements + 1):
            spacing = 2.0 * float(half.max()) / (self.options.grid_size - 1)
            positions = _grid(center, half, self.options.grid_size)
            if best is not None:
                positions = torch.cat([best.position.unsqueeze(0), positions])
            positions = self.feasible(positions, largest_gap=self._largest_gap(spacing))
            if not positions.shape[0]:
                return None
            best = self._pick(positions, cost(positions), contact, tolerance)
            # A cube, for the next grid has to reach as far along every axis as a gap that this one allowed.
            center, half = best.position, torch.full_like(half, spacing)
        return best

    def _largest_gap(self, spacing: float) -> float:
        """The gap that counts as touching on a grid of this spacing: the next grid can close as much."""
        if self.options.max_gap is None:
            return float("inf")
        return self.options.clearance + max(self.options.max_gap, spacing)

    def _pick(self, positions: Tensor, costs: Tensor, contact: Tensor, tolerance: float) -> GridResult:
        tied = costs <= costs.min() + tolerance
        distance = self.reduce(positions[tied], contact.unsqueeze(0), lambda distance: distance[:, 0].abs())
        chosen = int(distance.argmin())
        return GridResult(position=positions[tied][chosen], cost=float(costs[tied][chosen]))


def _grid(center: Tensor, half: Tensor, size: int) -> Tensor:
    """Positions (size^3, 3) that span `half` (3,) to either side of `center` (3,)."""
    steps = torch.linspace(-1.0, 1.0, size, dtype=center.dtype, device=center.device)
    return center + half * torch.cartesian_prod(steps, steps, steps)
