"""Where tools wait that take no part in a touch."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from cpdeform.core.clearance import CLEARANCE, smallest_gaps
from cpdeform.core.placer import Stage
from cpdeform.core.scene import Tool

HEIGHT = 0.9
"""Where they wait if they can: high above the clay, length units."""

PLACES = 9
"""Places along each axis that are looked at otherwise."""

MARGIN = 0.05
"""How far from the domain's faces these lie at least, length units, where the tool's bounds allow it."""

FAR = 0.3
"""Distance from the clay beyond which no place is better than another, length units."""


def parked(stage: Stage, movable: Sequence[int]) -> Tensor:
    """Poses (M, 8) with every movable tool where it is in nobody's way: high above the clay, or as far from it as it can be.

    Args:
        stage: The clay, the tools and where they are.
        movable: Indices of the movable tools.
    """
    poses = stage.state.tool_pose[0].detach().clone()
    particles = stage.state.position[0].detach()
    for number, index in enumerate(movable):
        tool = stage.scene.tools[index]
        lower, upper = poses.new_tensor(tool.lower_bound), poses.new_tensor(tool.upper_bound)
        place = poses.new_tensor([(number + 0.5) / len(movable), HEIGHT, 0.5]).clamp(lower, upper)
        if float(smallest_gaps(tool, poses[index, 3:7], place[None], particles, reach=CLEARANCE)[0]) < CLEARANCE:
            place = _farthest(tool, poses[index], particles, taken=[poses[other, :3] for other in movable[:number]])
        poses[index, :3] = place
    return poses


def _farthest(tool: Tool, pose: Tensor, particles: Tensor, *, taken: Sequence[Tensor]) -> Tensor:
    """The place (3,) of a lattice within a tool's bounds that is farthest from the clay and from places that are taken."""
    axes = []
    for least, most in zip(tool.lower_bound, tool.upper_bound, strict=True):
        low, high = max(least, MARGIN), min(most, 1.0 - MARGIN)
        low, high = (low, high) if low <= high else (least, most)
        axes.append(torch.linspace(low, high, PLACES if high > low else 1, dtype=pose.dtype, device=pose.device))
    places = torch.cartesian_prod(*axes)
    gaps = smallest_gaps(tool, pose[3:7], places, particles, reach=FAR).clamp(max=FAR)
    for other in taken:
        gaps = torch.minimum(gaps, torch.linalg.vector_norm(places - other, dim=-1))
    return places[int(gaps.argmax())]
