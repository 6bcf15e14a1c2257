"""Goals that are the body's own particles, put elsewhere: cubes moved about, a rope bent."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cpdeform.core.errors import InputError
from cpdeform.core.sampling import body_index, sample_particles
from cpdeform.core.scene import BodyBox, Scene, Vector3

Array = NDArray[np.float64]


def shifted_bodies(scene: Scene, shifts: Sequence[Vector3]) -> Array:
    """The particles (N, 3) of all bodies, length units, each body shifted by its own vector."""
    return sample_particles(scene) + np.asarray(shifts, dtype=np.float64)[body_index(scene)]


def bent_rope(scene: Scene, *, headings: Sequence[float], corner_length: float) -> Array:
    """A rope along x, bent in the plane of the floor to a polyline with rounded corners.

    Along the rope lengths stay as they are, across it too: each cross-section turns with the heading and follows the middle line.

    Args:
        scene: Its first body, a box that is longest along x, is the rope.
        headings: Angle of each segment to the x axis, radians, towards +z; the segments are of equal length.
        corner_length: Length along which the heading turns at a corner, length units.

    Returns:
        Positions (N, 3), length units; the centre of mass of the middle line stays where it was.

    Raises:
        InputError: The first body is no box.
    """
    rope = scene.bodies[0]
    if not isinstance(rope, BodyBox):
        raise InputError("scene.bodies.0", came=f"a {rope.kind}", expected="a box, the rope")
    particles = sample_particles(scene)
    length = rope.widths[0]
    along = np.linspace(0.0, length, 2001)
    corners = length * np.arange(1, len(headings)) / len(headings)
    steps = [
        turn * np.clip((along - corner) / corner_length + 0.5, 0.0, 1.0)
        for corner, turn in zip(corners, np.diff(headings), strict=True)
    ]
    heading = headings[0] + np.sum(steps, axis=0)
    middle = np.stack([_integral(np.cos(heading), along), _integral(np.sin(heading), along)], axis=1)
    middle += np.array([rope.position[0], rope.position[2]]) - middle.mean(axis=0)
    offset = particles[:, 0] - (rope.position[0] - 0.5 * length)
    angle = np.interp(offset, along, heading)
    aside = particles[:, 2] - rope.position[2]
    x = np.interp(offset, along, middle[:, 0]) - aside * np.sin(angle)
    z = np.interp(offset, along, middle[:, 1]) + aside * np.cos(angle)
    return np.stack([x, particles[:, 1], z], axis=1)


def _integral(values: Array, along: Array) -> Array:
    """Trapezoidal integral of values (K,) from the first place on, at all places (K,)."""
    pieces = 0.5 * (values[1:] + values[:-1]) * np.diff(along)
    return np.concatenate([[0.0], np.cumsum(pieces)])
