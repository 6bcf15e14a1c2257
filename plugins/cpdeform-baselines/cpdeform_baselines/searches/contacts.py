"""Contact plans as a few numbers: where the tools touch the clay, for searches that know nothing of transport."""

from __future__ import annotations

import torch
from torch import Tensor

from cpdeform.core.clearance import exit_distances, reduce_distances
from cpdeform.core.placer import Stage
from cpdeform.core.scene import Tool
from cpdeform.core.tool_surface import placed_surface
from cpdeform.placement.grasp import TOOLS_PER_GRASP, GraspSearch
from cpdeform.placement.grid import movable_tools
from cpdeform.placement.pose import GRASP_DIRECTIONS
from cpdeform.placement.random import surface_particles

NEIGHBOURS = 48
"""Particles that the direction off the surface is taken from."""

REACH = 0.5
"""How far a tool may have to back off from the surface, length units."""


class ContactSpace:
    """The contact plans of a stage: vectors of numbers in [0, 1], of one size, whatever the clay looks like.

    Three numbers are a point in the box around the clay; the particle of the surface that is nearest to it is the contact. A
    single tool is placed there with its rotation kept, backed off along the surface's normal until it is free of the clay and
    touches. Several tools are placed in pairs that face each other through the contact, along the axis that a fourth number
    chooses. Plans close to each other have contacts close to each other, which is what a search can learn from.

    Args:
        stage: Clay and tools.

    Attributes:
        size: Number of numbers D of a plan.

    Raises:
        CapabilityError: The scene has no movable tool.
    """

    def __init__(self, stage: Stage) -> None:
        movable = movable_tools(stage)
        self._tools = stage.scene.tools
        self._particles = stage.state.position[0].detach()
        self._poses = stage.state.tool_pose[0].detach()
        self._movable = movable
        self._groups = [movable[start : start + TOOLS_PER_GRASP] for start in range(0, len(movable), TOOLS_PER_GRASP)]
        self._numbers = 3 if len(movable) == 1 else 4
        self._surface = surface_particles(self._particles).to(self._particles.device)
        self._lower, self._upper = self._particles.amin(dim=0), self._particles.amax(dim=0)
        self.size = self._numbers * len(self._groups)

    def place(self, numbers: Tensor) -> tuple[Tensor, int] | None:
        """Place the tools.

        Args:
            numbers: A plan (D,), in [0, 1].

        Returns:
            Poses (M, 8) of all tools, free of collision and touching, and the first contact's particle; None where there is no
            room within the tools' bounds.
        """
        poses, first = self._poses.clone(), -1
        placed = [index for index in range(len(self._tools)) if index not in self._movable]
        for number, group in enumerate(self._groups):
            own = numbers[number * self._numbers : (number + 1) * self._numbers].clamp(0.0, 1.0)
            contact = self._contact(own[:3])
            found = (
                self._single(poses, group[0], contact) if self._numbers == 3 else self._grasp(poses, group, placed, contact, own[3])
            )
            if found is None:
                return None
            poses, placed, first = found, [*placed, *group], contact if number == 0 else first
        return poses, first

    def _contact(self, point: Tensor) -> int:
        """The surface's particle that is nearest to a point (3,) of the box around the clay, itself in [0, 1]."""
        place = self._lower + point.to(self._lower) * (self._upper - self._lower)
        return int(self._surface[(self._particles[self._surface] - place).norm(dim=-1).argmin()])

    def _single(self, poses: Tensor, index: int, contact: int) -> Tensor | None:
        tool, start = self._tools[index], self._particles[contact]
        fixed = [placed_surface(other, poses[at]) for at, other in enumerate(self._tools) if at != index]
        points = torch.cat([self._particles, *fixed])
        normal = self._normal(contact)
        length = exit_distances(tool, poses[index, 3:7], start.unsqueeze(0), normal, points, reach=REACH)[0]
        position = start + length * normal
        lower, upper = poses.new_tensor(tool.lower_bound), poses.new_tensor(tool.upper_bound)
        if not bool(torch.isfinite(length)) or not bool(((position >= lower) & (position <= upper)).all()):
            return None
        result = poses.clone()
        result[index, :3] = position
        return result

    def _grasp(self, poses: Tensor, group: list[int], placed: list[int], contact: int, choice: Tensor) -> Tensor | None:
        axes = list(GRASP_DIRECTIONS.values())
        direction = self._particles.new_tensor(axes[min(int(float(choice) * len(axes)), len(axes) - 1)])
        point = self._particles[contact]

        def gap(tool: Tool, quaternion: Tensor, positions: Tensor) -> Tensor:
            return reduce_distances(tool, quaternion, positions, point.unsqueeze(0), lambda distance: distance[:, 0])

        search = GraspSearch(tools=self._tools, particles=self._particles)
        found = search.find(poses, group, placed, point, direction, gap)
        return None if found is None else found.poses

    def _normal(self, contact: int) -> Tensor:
        """Unit vector (3,) off the surface at a particle: away from the middle of its neighbours."""
        distance = (self._particles - self._particles[contact]).norm(dim=-1)
        near = distance.topk(min(NEIGHBOURS, len(distance)), largest=False).indices
        direction: Tensor = self._particles[contact] - self._particles[near].mean(dim=0)
        length = direction.norm()
        up = self._particles.new_tensor([0.0, 1.0, 0.0])
        return direction / length if float(length) > 0.0 else up
