"""Every tool behind clay that has to move, on the side from which it pushes it where transport wants it."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import torch
from torch import Tensor

from cpdeform.core.clearance import CHUNK_DISTANCES, exit_distances, tool_half_extents
from cpdeform.core.scene import Tool
from cpdeform.core.tool_surface import placed_surface
from cpdeform.placement.pose import turned

REACH = 4.0
"""How far a tool may have to move out of the clay, in its half largest width: farther away it is not behind this clay any more."""


@dataclasses.dataclass(frozen=True)
class Push:
    """Clay to be moved.

    Attributes:
        contact: Index of the particle in its middle.
        direction: Where it has to go, a unit vector (3,).
        score: How much of it there is and how far it has to go, length units, see `PushSearch`.
    """

    contact: int
    direction: Tensor
    score: float


class PushSearch:
    """Shares out the displacements that transport asks for among the tools, one push after the other.

    The paper's score of a place x is 1/N sum_i f_i / (d(i, x)^2 + 1), with numbers f_i. Here it is taken of the displacements u_i,
    around particles instead of tools, and is a vector: clay that has to go different ways does not count together, and neither does
    the noise of two samples. The clay of the longest vector is pushed along it. What this push does, the part of each u_i along its
    direction, the less the farther away, is then taken off, and the next tool takes what is left. So two tools do not push at
    the same place, and each pushes from the side that its clay is to leave.

    Args:
        tools: The scene's tools.
        particles: All particles (N, 3), length units.
        displacements: Where transport moves each of them (N, 3), length units.
        distance_scale: Length that distances d are measured in.
        clearance: Least distance between a tool and any particle or other tool, length units.
    """

    def __init__(
        self,
        *,
        tools: Sequence[Tool],
        particles: Tensor,
        displacements: Tensor,
        distance_scale: float,
        clearance: float = 0.0,
    ) -> None:
        self._tools, self._particles, self._clearance = tools, particles, clearance
        self._remaining, self._scale = displacements.to(particles).clone(), distance_scale

    def next(self, allowed: Tensor) -> Push | None:
        """The push of the largest score around one of the allowed particles (N,); None where nothing is left to be moved."""
        points = torch.nonzero(allowed).flatten()
        # In pieces: all distances between 10,000 particles would take 400 MB.
        pieces = torch.split(points, max(1, CHUNK_DISTANCES // self._particles.shape[0]))
        vectors = torch.cat([self._weights(piece) @ self._remaining for piece in pieces]) / self._particles.shape[0]
        scores = torch.linalg.vector_norm(vectors, dim=-1)
        if not points.numel() or not float(scores.max()) > 0.0:
            return None
        chosen = int(scores.argmax())
        return Push(int(points[chosen]), vectors[chosen] / scores[chosen], float(scores[chosen]))

    def take_off(self, push: Push) -> None:
        """Take off what a push does, so that the next one is about the rest."""
        weights = self._weights(torch.tensor([push.contact], device=self._particles.device))[0]
        done = (self._remaining @ push.direction).clamp(min=0.0) * weights
        self._remaining -= done.unsqueeze(-1) * push.direction

    def place(self, push: Push, poses: Tensor, index: int, obstacles: Sequence[int]) -> Tensor | None:
        """Put a tool behind the clay of a push: moved out of it against the push's direction, until it just touches.

        Where its bounds are in the way along some axes, the tool stands as if the clay had to go straight across these.

        Args:
            push: The clay.
            poses: Poses (M, 8) of all tools.
            index: The tool to be placed.
            obstacles: Indices of tools that must not be touched.

        Returns:
            Its pose (8,); None where there is no room, or where it would have to pass through more clay than that of the push.
        """
        tool, contact, direction = self._tools[index], self._particles[push.contact], push.direction
        points = torch.cat([self._particles, *(placed_surface(self._tools[other], poses[other]) for other in obstacles)])
        lower, upper = contact.new_tensor(tool.lower_bound), contact.new_tensor(tool.upper_bound)
        start = contact.clamp(lower, upper)
        for _ in range(3):
            quaternion = turned(tool, direction)
            length = exit_distances(
                tool,
                quaternion,
                start.unsqueeze(0),
                -direction,
                points,
                reach=REACH * float(tool_half_extents(tool, quaternion).max()),
                clearance=self._clearance,
            )[0]
            if not bool(torch.isfinite(length)):
                return None
            position = start - length * direction
            outside = (position < lower) | (position > upper)
            if not bool(outside.any()):
                return torch.cat([position, quaternion, poses[index, 7:]])
            direction = direction.masked_fill(outside, 0.0)
            if not bool(direction.any()):
                return None
            direction = direction / torch.linalg.vector_norm(direction)
        return None

    def _weights(self, points: Tensor) -> Tensor:
        """The paper's weights 1 / (d^2 + 1) (P, N) of all particles around those with the given indices (P,)."""
        distance = torch.cdist(self._particles[points], self._particles) / self._scale
        return 1.0 / (distance * distance + 1.0)
