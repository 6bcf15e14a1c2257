"""Random goals that are the clay itself, put elsewhere: a rope bent along the floor, cubes at other places."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from cpdeform.core.errors import InputError
from cpdeform.core.sampling import sample_particles
from cpdeform.core.scene import BodyBox, Scene
from cpdeform.core.signed_distance import signed_distance
from cpdeform.core.state import tool_pose
from cpdeform.tasks.rearrangements import bent_rope, shifted_bodies

Array = NDArray[np.float64]

GAP = 0.06
"""Room that is left for a tool between cubes and between bends of a rope, length units."""

MARGIN = 0.08
"""Distance from the domain's faces, length units."""

LEAST_WAY = 0.1
"""How far some part of a rope is moved, length units, at least."""

ATTEMPTS = 1000


def random_rope(scene: Scene, rng: np.random.Generator) -> Array:
    """A rope with random headings: 3 to 5 straight pieces, bent by up to 80 degrees at the corners.

    Args:
        scene: Its first body, a box that is longest along x, is the rope.
        rng: Where random numbers come from.

    Returns:
        The body's particles (N, 3), moved, length units.

    Raises:
        InputError: There is no room for a bend.
    """
    body = scene.bodies[0]
    for _ in range(ATTEMPTS):
        pieces = int(rng.integers(3, 6))
        headings = np.cumsum([rng.uniform(-0.6, 0.6), *rng.uniform(-1.4, 1.4, pieces - 1)])
        if np.abs(headings).max() > math.radians(100.0) or np.abs(np.diff(headings)).max() < math.radians(30.0):
            continue
        position = bent_rope(scene, headings=[float(heading) for heading in headings], corner_length=0.1)
        start = sample_particles(scene)
        moved = float(np.linalg.norm(position - start, axis=1).max()) >= LEAST_WAY
        if moved and _has_room(position, scene) and _apart_from_itself(start, position, width=body.half_extents[2]):
            return position
    raise InputError("scene", came="a rope that could not be bent", expected="room on the floor around it")


def random_cubes(scene: Scene, rng: np.random.Generator) -> Array:
    """All bodies at random places on the floor, each moved by 0.08 to 0.24, with room for a tool between them.

    Args:
        scene: Its bodies are moved.
        rng: Where random numbers come from.

    Returns:
        The bodies' particles (N, 3), moved, length units.

    Raises:
        InputError: There is no room.
    """
    centres = np.array([[body.position[0], body.position[2]] for body in scene.bodies])
    halves = np.array([max(body.half_extents[0], body.half_extents[2]) for body in scene.bodies])
    for _ in range(ATTEMPTS):
        ways, angles = rng.uniform(0.08, 0.24, len(centres)), rng.uniform(0.0, 2.0 * math.pi, len(centres))
        shifts = np.stack([ways * np.cos(angles), ways * np.sin(angles)], axis=1)
        places = centres + shifts
        gaps = np.abs(places[:, None] - places[None]).max(axis=2) - halves[:, None] - halves[None]
        np.fill_diagonal(gaps, np.inf)
        position = shifted_bodies(scene, [(float(x), 0.0, float(z)) for x, z in shifts])
        if gaps.min() >= GAP and _has_room(position, scene):
            return position
    raise InputError("scene", came="bodies that could not be moved apart", expected="room on the floor around them")


def is_rope(scene: Scene) -> bool:
    """Whether the scene's clay is a rope along x: a box four times as long as wide."""
    body = scene.bodies[0]
    return len(scene.bodies) == 1 and isinstance(body, BodyBox) and body.widths[0] > 4.0 * max(body.widths[1:])


def _has_room(position: Array, scene: Scene) -> bool:
    """Whether particles (N, 3) keep away from the walls and from fixed tools."""
    import torch

    aside = position[:, [0, 2]]
    if aside.min() < MARGIN or aside.max() > 1.0 - MARGIN:
        return False
    points, poses = torch.as_tensor(position), tool_pose(scene)
    fixed = [(tool, poses[index]) for index, tool in enumerate(scene.tools) if not tool.movable]
    return all(float(signed_distance(tool, pose, points).min()) > 0.0 for tool, pose in fixed)


def _apart_from_itself(start: Array, position: Array, *, width: float) -> bool:
    """Whether parts of the rope that are far apart along it stay apart by the room of a tool; `width` is half of the rope's."""
    from scipy.spatial import cKDTree

    along = np.argsort(start[:, 0])[:: max(1, len(start) // 300)]
    pairs = cKDTree(position[along][:, [0, 2]]).query_pairs(GAP + 2.0 * width, output_type="ndarray")
    lengths = np.abs(start[along][pairs[:, 0], 0] - start[along][pairs[:, 1], 0])
    return bool((lengths < 3.0 * (GAP + 2.0 * width)).all())
