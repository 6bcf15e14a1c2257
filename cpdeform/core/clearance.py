"""How near tools are to the clay, and how far one has to move to be free of it."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from cpdeform.core.rotation import rotate, rotate_inverse
from cpdeform.core.scene import Tool
from cpdeform.core.shapes.base import Shape
from cpdeform.core.shapes.tool import shape_of

CLEARANCE = 5e-4
"""Distance from the clay at which a tool begins a touch, length units."""

CHUNK_DISTANCES = 2**18
"""Distances computed at once: small enough for the temporaries to stay in a processor's cache."""

SMALLEST_STEP = 1e-3
"""The least a tool is moved at a time on its way out, length units."""

MOST_STEPS = 64
"""Steps after which a tool that is still not free is given up: it slides along the surface."""

BISECTIONS = 12
"""Halvings of the last step; they leave the tool within 1/4096 of it of touching."""

MOST_PUSHES = 32
"""Pushes off the deepest point after which a tool that still touches is given up: it is wedged in."""

PUSHED_DEPTH, PUSHED_WAY = 0.9, 2.0
"""The deepest that a tool may be in to be pushed out, and the farthest it is pushed, both in its half smallest width. One that is
deeper in has clay on both sides, and no nearest side to leave by."""

ROUNDING = 1e-6
"""How much less than the clearance is enough, length units."""

LEAST_SLOPE = 0.01
"""Square of the part of a normal that is not downwards, below which pushing along it would lead nowhere."""

GRAZING_DEPTH = 0.5
"""Depth at the start, in the tool's half smallest width, below which it only grazes the points and would not press on them."""


def tool_half_extents(tool: Tool, quaternion: Tensor) -> Tensor:
    """Half edges of the axis-aligned box around a rotated tool.

    Args:
        tool: The tool.
        quaternion: Its rotation (4,), unit quaternion wxyz.

    Returns:
        Half edges (3,) along the world's axes, length units.

    Raises:
        InputError: `tool` is no tool.
    """
    axes = rotate(quaternion, torch.eye(3, dtype=quaternion.dtype, device=quaternion.device)).T.abs()
    return shape_of(tool).half_extents(axes)


def reduce_distances(
    tool: Tool, quaternion: Tensor, positions: Tensor, points: Tensor, reduction: Callable[[Tensor], Tensor]
) -> Tensor:
    """Reduce the distances of points to a tool at each of several positions, in bounded memory.

    Args:
        tool: The tool, at its start gap.
        quaternion: Its rotation (4,), unit quaternion wxyz.
        positions: Tool positions (G, 3), length units.
        points: Points (P, 3), length units.
        reduction: Maps distances (g, P) of a piece of the positions to numbers (g,).

    Returns:
        Numbers (G,).
    """
    local_positions, local_points = rotate_inverse(quaternion, positions), rotate_inverse(quaternion, points)
    return _reduce_local(shape_of(tool), local_positions, local_points, reduction)


def _reduce_local(shape: Shape, positions: Tensor, points: Tensor, reduction: Callable[[Tensor], Tensor]) -> Tensor:
    """Reduce the distances of points (P, 3) to a shape at positions (G, 3), all in its local frame, to numbers (G,)."""
    step = max(1, CHUNK_DISTANCES // max(1, points.shape[0]))
    coordinates = points.unbind(-1)
    parts = []
    for chunk in torch.split(positions, step):
        axes = [point - origin.unsqueeze(-1) for point, origin in zip(coordinates, chunk.unbind(-1), strict=True)]
        parts.append(reduction(shape.quick_distance(*axes)))
    return torch.cat(parts) if parts else positions.new_empty(0)


def _within(points: Tensor, positions: Tensor, extents: Tensor) -> Tensor:
    """Which points (P,) lie in the box around positions (G, 3), grown by half edges (3,), length units."""
    return ((points >= positions.amin(0) - extents) & (points <= positions.amax(0) + extents)).all(dim=-1)


def smallest_gaps(tool: Tool, quaternion: Tensor, positions: Tensor, points: Tensor, *, reach: float = 0.0) -> Tensor:
    """Distance (G,) between a tool at each position (G, 3) and the nearest of the points (P, 3); exact up to `reach`.

    A larger distance may come out as infinity.
    """
    if not positions.shape[0]:
        return positions.new_empty(0)
    # Only what lies in the box swept by the tool can be that near.
    near = _within(points, positions, tool_half_extents(tool, quaternion) + reach)
    if not bool(near.any()):
        return torch.full_like(positions[:, 0], torch.inf)
    return reduce_distances(tool, quaternion, positions, points[near], lambda distance: distance.amin(dim=-1))


def exit_distances(
    tool: Tool,
    quaternion: Tensor,
    starts: Tensor,
    direction: Tensor,
    points: Tensor,
    *,
    reach: float,
    clearance: float = 0.0,
    least_depth: float | None = None,
) -> Tensor:
    """How far a tool has to move along a direction until it is free of all points for the first time.

    Since a distance changes by no more than the tool moves, a tool that reaches a depth into the points is not free before it
    has moved by that depth: such steps never pass over a gap that is wide enough for the tool.

    Args:
        tool: The tool.
        quaternion: Its rotation (4,), unit quaternion wxyz.
        starts: Positions (G, 3) to start from, length units.
        direction: Unit vector (3,).
        points: Points (P, 3) to get free of, length units.
        reach: The farthest to move, length units.
        clearance: Distance that counts as free, length units.
        least_depth: How deep it has to reach into the points at its start, length units, negative for a distance from them;
            defaults to `GRAZING_DEPTH`.

    Returns:
        Distances (G,), length units, at which the tool is free and touches; infinity where it is not free within `reach`, or
        not deep enough at its start.
    """
    lengths = torch.full_like(starts[:, 0], torch.inf)
    extents = tool_half_extents(tool, quaternion)
    depth = GRAZING_DEPTH * float(extents.min()) if least_depth is None else least_depth
    # All is computed in the tool's frame, with the points that it may come near to on its way: rotating them at each step would
    # take longer than their distances.
    way = torch.cat([starts, starts + (reach + float(extents.max())) * direction])
    near = _within(points, way, extents + max(clearance, -depth, 0.0))
    if not bool(near.any()):
        return lengths
    local_points = rotate_inverse(quaternion, points[near])
    local_starts, local_direction = rotate_inverse(quaternion, starts), rotate_inverse(quaternion, direction)
    shape = shape_of(tool)

    def gaps_at(lines: Tensor, distances: Tensor) -> Tensor:
        positions = local_starts[lines] + distances.unsqueeze(-1) * local_direction
        return _reduce_local(shape, positions, local_points, lambda distance: distance.amin(dim=-1))

    gaps = gaps_at(torch.arange(len(starts), device=starts.device), torch.zeros_like(lengths))
    active = torch.nonzero(gaps <= -depth).flatten()
    moved, gaps, steps = torch.zeros_like(gaps)[active], gaps[active], torch.zeros_like(gaps)
    for _ in range(MOST_STEPS):
        step = (clearance - gaps).clamp(min=SMALLEST_STEP)
        moved = moved + step
        gaps = gaps_at(active, moved)
        free = gaps >= clearance
        lengths[active[free]], steps[active[free]] = moved[free], step[free]
        going = ~free & (moved <= reach)
        active, moved, gaps = active[going], moved[going], gaps[going]
        if not active.numel():
            break
    found = torch.nonzero(torch.isfinite(lengths)).flatten()
    high, step = lengths[found], steps[found]
    for _ in range(BISECTIONS):
        step = 0.5 * step
        high = torch.where(gaps_at(found, high - step) >= clearance, high - step, high)
    lengths[found] = high
    return lengths


def push_out(tool: Tool, pose: Tensor, points: Tensor, *, clearance: float, touching: float) -> Tensor:
    """Where a tool comes free of the points: pushed off the one that is deepest in it, time and again, never downwards.

    It goes about as far as it is too near, so that a little deeper is moved a little farther.

    Args:
        tool: The tool.
        pose: Its pose (8,).
        points: Points (P, 3) to get free of, length units.
        clearance: Distance that counts as free, length units.
        touching: Distance at which it is left where it is at first, length units, at most the clearance.

    Returns:
        Position (3,), length units; infinity where it would not come free, or where `PUSHED_DEPTH` or `PUSHED_WAY` is not enough.
    """
    shape, quaternion, position = shape_of(tool), pose[3:7], pose[:3]
    extents = tool_half_extents(tool, quaternion)
    half_width = float(shape.half_extents(torch.eye(3, dtype=pose.dtype, device=pose.device)).min())
    farthest = PUSHED_WAY * half_width
    near = points[_within(points, position[None], extents + clearance + farthest)]
    if not len(near):
        return position
    nowhere = torch.full_like(position, torch.inf)
    for number in range(MOST_PUSHES):
        distances, normals = shape.distance_and_gradient(rotate_inverse(quaternion, near - position))
        nearest = int(distances.argmin())
        distance = float(distances[nearest])
        if distance >= (clearance - ROUNDING if number else touching):
            return position
        away = -rotate(quaternion, normals[nearest])
        away[1] = away[1].clamp(min=0.0)
        square = float(away.square().sum())
        if square < LEAST_SLOPE or (number == 0 and -distance > PUSHED_DEPTH * half_width):
            return nowhere
        # The distance grows by the part of the step that goes along the normal.
        position = position + ((clearance - distance) / square) * away
        if float(torch.linalg.vector_norm(position - pose[:3])) > farthest:
            return nowhere
    return nowhere
