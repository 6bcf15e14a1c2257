"""Solids composed of primitives, and particles that fill them evenly.

A solid is made as large as the clay that it is to be made of: its volume is that of the scene's bodies.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from cpdeform.core.meshes.filling import even_points, fill_evenly
from cpdeform.core.scene import Body, Scene, Vector3
from cpdeform.core.simulator import Simulator

Array = NDArray[np.float64]

VOLUME_POINTS = 2**18
"""Points that a solid's volume is measured with; spread evenly, they give it to about 1e-4 of itself."""


class Primitive(Protocol):
    """A simple shape, part of a solid."""

    @property
    def corners(self) -> tuple[Vector3, Vector3]:
        """Lower and upper corner of a box around the shape, length units."""

    def contains(self, points: Array) -> NDArray[np.bool_]:
        """Whether each of the points (K, 3), length units, is inside: (K,)."""


@dataclasses.dataclass(frozen=True)
class Block:
    """An axis-aligned block between two corners, length units, whose vertical edges are rounded by `rounding`."""

    lower: Vector3
    upper: Vector3
    rounding: float = 0.0

    @property
    def corners(self) -> tuple[Vector3, Vector3]:
        """See `Primitive`."""
        return self.lower, self.upper

    def contains(self, points: Array) -> NDArray[np.bool_]:
        """See `Primitive`."""
        lower, upper = np.asarray(self.lower), np.asarray(self.upper)
        excess = np.abs(points - 0.5 * (lower + upper)) - 0.5 * (upper - lower)
        beyond = np.maximum(excess[:, [0, 2]] + self.rounding, 0.0)
        return np.asarray((excess <= 0.0).all(axis=1) & ((beyond**2).sum(axis=1) <= self.rounding**2 + 1e-15))


@dataclasses.dataclass(frozen=True)
class Ellipsoid:
    """An ellipsoid with the given centre and semi-axes (3,) along x, y and z, length units."""

    centre: Vector3
    semi_axes: Vector3

    @property
    def corners(self) -> tuple[Vector3, Vector3]:
        """See `Primitive`."""
        centre, semi_axes = np.asarray(self.centre), np.asarray(self.semi_axes)
        return _vector(centre - semi_axes), _vector(centre + semi_axes)

    def contains(self, points: Array) -> NDArray[np.bool_]:
        """See `Primitive`."""
        return np.asarray((((points - np.asarray(self.centre)) / np.asarray(self.semi_axes)) ** 2).sum(axis=1) <= 1.0)


@dataclasses.dataclass(frozen=True)
class Turned:
    """A body of revolution about a vertical axis.

    Attributes:
        axis: Where it stands, x and z, length units.
        profile: Pairs of height and radius from the bottom to the top, length units; straight between them.
    """

    axis: tuple[float, float]
    profile: tuple[tuple[float, float], ...]

    @property
    def corners(self) -> tuple[Vector3, Vector3]:
        """See `Primitive`."""
        radius = max(radius for _, radius in self.profile)
        low, high = self.profile[0][0], self.profile[-1][0]
        return (self.axis[0] - radius, low, self.axis[1] - radius), (self.axis[0] + radius, high, self.axis[1] + radius)

    def contains(self, points: Array) -> NDArray[np.bool_]:
        """See `Primitive`."""
        heights, radii = np.asarray(self.profile).T
        distance = np.hypot(points[:, 0] - self.axis[0], points[:, 2] - self.axis[1])
        within = (points[:, 1] >= heights[0]) & (points[:, 1] <= heights[-1])
        return np.asarray(within & (distance <= np.interp(points[:, 1], heights, radii)))


@dataclasses.dataclass(frozen=True)
class Prism:
    """A polygon with the corners `outline`, pairs of x and z, between the heights `low` and `high`, length units."""

    outline: tuple[tuple[float, float], ...]
    low: float
    high: float

    @property
    def corners(self) -> tuple[Vector3, Vector3]:
        """See `Primitive`."""
        outline = np.asarray(self.outline)
        (x_low, z_low), (x_high, z_high) = outline.min(axis=0), outline.max(axis=0)
        return (float(x_low), self.low, float(z_low)), (float(x_high), self.high, float(z_high))

    def contains(self, points: Array) -> NDArray[np.bool_]:
        """See `Primitive`."""
        inside = np.zeros(len(points), dtype=bool)
        for (x, z), (x_next, z_next) in zip(self.outline, self.outline[1:] + self.outline[:1], strict=True):
            # A ray towards +x crosses an edge where the edge's ends lie on both sides of it.
            crosses = (points[:, 2] < z) != (points[:, 2] < z_next)
            slope = (x_next - x) / (z_next - z) if z_next != z else 0.0
            inside ^= crosses & (points[:, 0] < x + (points[:, 2] - z) * slope)
        return inside & (points[:, 1] >= self.low) & (points[:, 1] <= self.high)


@dataclasses.dataclass(frozen=True)
class Solid:
    """The union of primitives, scaled about `origin` along the axes in `scaled_axes` (0: x, 1: y, 2: z).

    Attributes:
        parts: The primitives.
        origin: The point that stays where it is, length units.
        scaled_axes: Axes along which `fitted_to` scales.
        scale: Factor along these axes.
    """

    parts: tuple[Primitive, ...]
    origin: Vector3
    scaled_axes: tuple[int, ...] = (0, 1, 2)
    scale: float = 1.0

    @property
    def factors(self) -> Array:
        """Factor (3,) along each axis."""
        return np.array([self.scale if axis in self.scaled_axes else 1.0 for axis in range(3)])

    @property
    def corners(self) -> tuple[Array, Array]:
        """Lower and upper corner (3,) of a box around the solid, length units."""
        origin = np.asarray(self.origin)
        lower = np.min([part.corners[0] for part in self.parts], axis=0)
        upper = np.max([part.corners[1] for part in self.parts], axis=0)
        return origin + (lower - origin) * self.factors, origin + (upper - origin) * self.factors

    def contains(self, points: Array) -> NDArray[np.bool_]:
        """Whether each of the points (K, 3), length units, is inside: (K,)."""
        origin = np.asarray(self.origin)
        unscaled = origin + (points - origin) / self.factors
        return np.asarray(np.logical_or.reduce([part.contains(unscaled) for part in self.parts]))

    def volume(self) -> float:
        """Volume, cubic length units."""
        lower, upper = self.corners
        points = lower + even_points(VOLUME_POINTS) * (upper - lower)
        return float(np.prod(upper - lower) * self.contains(points).mean())

    def fitted_to(self, volume: float) -> Solid:
        """The same solid, scaled to a volume, cubic length units."""
        return dataclasses.replace(self, scale=self.scale * (volume / self.volume()) ** (1.0 / len(self.scaled_axes)))

    def positions(self, scene: Scene, simulator: Callable[[], Simulator] | None = None) -> Array:
        """Particles (N, 3) that fill the solid, as many and of the volume of the scene's bodies, length units."""
        return fill_evenly(self.fitted_to(sum(body_volume(body) for body in scene.bodies)), scene.particle_count)


def body_volume(body: Body) -> float:
    """Volume of a body at the start, cubic length units."""
    return body.volume


def _vector(values: Array) -> Vector3:
    x, y, z = (float(value) for value in values)
    return x, y, z
