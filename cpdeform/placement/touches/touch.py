"""The interface of touches, and the room that they are placed in."""

from __future__ import annotations

import abc
import dataclasses
import math
from collections.abc import Mapping
from typing import ClassVar, Self

import numpy as np
import torch
from torch import Tensor

from cpdeform.core.clearance import CLEARANCE, exit_distances, tool_half_extents
from cpdeform.core.rotation import multiply, rotate
from cpdeform.core.scene import Scene, Tool
from cpdeform.core.tool_surface import ToolSurfaces

LEAST_DEPTH = 5e-4
"""How deep a tool at the contact point has to reach into the clay, length units: otherwise it would pass it by."""

REACH = 0.4
"""How far behind a contact point a tool is looked for, length units."""

BETWEEN_TOOLS = 1e-3
"""Least distance between tools, length units."""

Vector = np.ndarray[tuple[int], np.dtype[np.float64]]


@dataclasses.dataclass(frozen=True)
class Move:
    """What a touch does with one tool.

    Attributes:
        pose: Its pose (8,) at the beginning.
        way: Where it goes from there, a vector (3,), length units.
        then: Where it goes after that; None for nowhere.
    """

    pose: Tensor
    way: Tensor
    then: Tensor | None = None


@dataclasses.dataclass(frozen=True, kw_only=True)
class Room:
    """The clay of a stage and the tools that may touch it.

    Attributes:
        scene: Its tools.
        particles: All particles (N, 3), length units.
        poses: Poses (M, 8) of all tools at the stage's start.
        floors: How low each movable tool may reach, by index, length units: to the lowest particle, or as low as the scene puts it.
        surfaces: Those of the tools.
    """

    scene: Scene
    particles: Tensor
    poses: Tensor
    floors: Mapping[int, float]
    surfaces: ToolSurfaces

    @property
    def movable(self) -> list[int]:
        """Indices of the movable tools."""
        return [index for index, tool in enumerate(self.scene.tools) if tool.movable]

    def nearest(self, contact: Vector) -> int:
        """Index of the particle nearest to a point (3,), length units."""
        return int(torch.linalg.vector_norm(self.particles - torch.as_tensor(contact).to(self.particles), dim=-1).argmin())

    def behind(self, index: int, rotation: Tensor, contact: Tensor, direction: Tensor) -> Tensor | None:
        """Pose of a tool moved from a contact point against a direction until it is just free of the clay.

        Args:
            index: The tool.
            rotation: Its rotation (4,), unit quaternion wxyz.
            contact: Contact point (3,), length units; raised where the tool would reach below the floor.
            direction: Unit vector (3,) in which the tool is to push.

        Returns:
            The pose (8,); None where there is no room within the tool's bounds and above its floor.
        """
        tool = self.scene.tools[index]
        low = self.floors[index] + float(tool_half_extents(tool, rotation)[1])
        start = contact.clone()
        start[1] = max(float(start[1]), low)
        way = {"reach": REACH, "clearance": CLEARANCE, "least_depth": LEAST_DEPTH}
        length = float(exit_distances(tool, rotation, start.unsqueeze(0), -direction, self.particles, **way)[0])
        position = start - length * direction
        lower, upper = position.new_tensor(tool.lower_bound), position.new_tensor(tool.upper_bound)
        within = math.isfinite(length) and bool(((position >= lower) & (position <= upper)).all())
        if not within or float(position[1]) < low - 1e-6:
            return None
        return torch.cat([position, rotation, self.poses[index, 7:]])

    def apart(self, moves: dict[int, Move]) -> bool:
        """Whether the tools of a touch are free of each other and of the other tools."""
        poses = self.poses.clone()
        for index, move in moves.items():
            poses[index] = move.pose
        return all(bool((self.surfaces.gaps(index, poses) >= BETWEEN_TOOLS).all()) for index in moves)


class Touch(abc.ABC):
    """A placement of some tools and their first motion, in a few numbers.

    Attributes:
        name: Short name.
        contact: Contact point (3,), length units; of several tools, that of the first.
    """

    name: ClassVar[str]
    contact: Vector

    @abc.abstractmethod
    def moves(self, room: Room) -> dict[int, Move] | None:
        """What each of its tools does, by index; None where there is no room for it."""

    @abc.abstractmethod
    def varied(self, generator: np.random.Generator, width: float) -> Touch:
        """A touch near this one.

        Args:
            generator: Source of randomness.
            width: How far away, 1 for a wide search.
        """


@dataclasses.dataclass(frozen=True, kw_only=True)
class TouchSingle(Touch):
    """A touch of one tool, along a direction.

    Attributes:
        tool: Index of the tool.
        contact: Contact point (3,), length units.
        direction: Where it moves the clay (3,); its length does not count.
        way: How far, length units.
    """

    tool: int
    contact: Vector
    direction: Vector
    way: float

    def varied(self, generator: np.random.Generator, width: float) -> Self:
        """See `Touch`."""
        return dataclasses.replace(
            self,
            contact=moved(self.contact, generator, width),
            direction=turned_aside(self.direction, generator, width),
            way=scaled(self.way, generator, width),
        )


def facing(tool: Tool, direction: Tensor, *, edge: bool, roll: float) -> Tensor:
    """Rotation in which a flat tool turns its broad face (or its edge) along a direction, upright where it can be, then rolled.

    Args:
        tool: The tool; a round one keeps its start rotation.
        direction: Unit vector (3,).
        edge: Whether it is the edge.
        roll: Angle about the direction, radians.

    Returns:
        Unit quaternion (4,), wxyz.
    """
    start = torch.as_tensor(tool.rotation_wxyz).to(direction)
    thin = tool.thinnest_axis
    if thin is None:
        return _normalised(start)
    normal, up = torch.zeros_like(direction), torch.zeros_like(direction)
    normal[2 - thin if edge and thin != 1 else thin] = 1.0
    up[1 if thin != 1 else 2] = 1.0
    turn = turn_between(normal, direction)
    now, wanted = rotate(turn, up), direction.new_tensor([0.0, 1.0, 0.0])
    wanted = wanted - (wanted @ direction) * direction
    if float(wanted.norm()) > 0.2:
        wanted, now = wanted / wanted.norm(), now - (now @ direction) * direction
        angle = math.atan2(float(torch.linalg.cross(now, wanted) @ direction), float(now @ wanted))
        turn = multiply(turn_about(direction, angle), turn)
    return multiply(turn_about(direction, roll), turn)


def turn_between(first: Tensor, second: Tensor) -> Tensor:
    """The smallest rotation (4,) that takes one unit vector (3,) to another."""
    if float(first @ second) < -0.9999:
        axis = torch.linalg.cross(first, first.new_tensor([0.3, 0.5, 0.8]))
        return torch.cat([axis.new_zeros(1), axis / axis.norm()])
    return _normalised(torch.cat([(1.0 + first @ second).reshape(1), torch.linalg.cross(first, second)]))


def turn_about(axis: Tensor, angle: float) -> Tensor:
    """Rotation (4,) about a unit vector (3,) by an angle, radians."""
    return torch.cat([axis.new_tensor([math.cos(0.5 * angle)]), math.sin(0.5 * angle) * axis])


def aside(direction: Tensor, angle: float) -> Tensor:
    """Unit vector (3,) across a direction: level for the angle 0, above it for a quarter turn."""
    level = torch.linalg.cross(direction.new_tensor([0.0, 1.0, 0.0]), direction)
    level = level / level.norm() if float(level.norm()) > 1e-3 else direction.new_tensor([1.0, 0.0, 0.0])
    return rotate(turn_about(direction, angle), level)


def moved(contact: Vector, generator: np.random.Generator, width: float) -> Vector:
    """A contact point nearby."""
    return contact + 0.012 * width * generator.standard_normal(3)


def turned_aside(direction: Vector, generator: np.random.Generator, width: float) -> Vector:
    """A direction nearby; one along an axis or in a plane stays there."""
    free = np.abs(direction) > 1e-3 * np.linalg.norm(direction)
    return direction + 0.12 * width * float(np.linalg.norm(direction)) * generator.standard_normal(3) * free


def scaled(length: float, generator: np.random.Generator, width: float) -> float:
    """A length nearby."""
    return length * math.exp(0.3 * width * float(generator.standard_normal()))


def unit(direction: Vector, like: Tensor) -> Tensor:
    """A direction as a unit vector (3,) of the type of a tensor."""
    return _normalised(torch.as_tensor(direction).to(like))


def _normalised(vector: Tensor) -> Tensor:
    length: Tensor = torch.linalg.vector_norm(vector)
    return vector / length.clamp(min=1e-9)
