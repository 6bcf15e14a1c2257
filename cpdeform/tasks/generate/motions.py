"""Random scripted motions of a scene's own tools: strokes and letters of a pen, dents of a ball, variations of shipped scripts.

What they leave is within reach by construction: the tools have made it.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np

from cpdeform.core.errors import InputError
from cpdeform.core.scene import Body, Scene, ToolSphere, Vector3
from cpdeform.tasks.letters import LETTERS, Polyline, draw
from cpdeform.tasks.scripts import Leg
from cpdeform.tasks.single_stage import SCRIPTS

CLEAR = 0.002
"""Distance from the clay at which a tool begins and ends, length units."""

LETTER_GAP = 0.09
"""Room between letters, length units: a stroke is 0.06 wide."""

ALPHABET: Mapping[str, tuple[Polyline, ...]] = MappingProxyType(
    {
        **LETTERS,
        "A": (((0.0, 1.0), (0.5, 0.0), (1.0, 1.0)),),  # without its bar, which would close the narrow gap
        "H": (((0.0, 0.0), (0.0, 1.0)), ((0.0, 0.5), (1.0, 0.5)), ((1.0, 0.0), (1.0, 1.0))),
        "J": (((1.0, 0.0), (1.0, 0.7), (0.7, 1.0), (0.0, 1.0)),),
        "N": (((0.0, 1.0), (0.0, 0.0), (1.0, 1.0), (1.0, 0.0)),),
        "O": (((0.3, 0.0), (0.0, 0.3), (0.0, 0.7), (0.3, 1.0), (0.7, 1.0), (1.0, 0.7), (1.0, 0.3), (0.7, 0.0), (0.3, 0.0)),),
        "S": (((1.0, 0.0), (0.2, 0.0), (0.0, 0.25), (0.2, 0.5), (0.8, 0.5), (1.0, 0.75), (0.8, 1.0), (0.0, 1.0)),),
        "T": (((0.0, 0.0), (1.0, 0.0)), ((0.5, 0.0), (0.5, 1.0))),
        "U": (((0.0, 0.0), (0.0, 0.7), (0.3, 1.0), (0.7, 1.0), (1.0, 0.7), (1.0, 0.0)),),
        "V": (((0.0, 0.0), (0.5, 1.0), (1.0, 0.0)),),
        "X": (((0.0, 0.0), (1.0, 1.0)), ((1.0, 0.0), (0.0, 1.0))),
        "Z": (((0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (1.0, 1.0)),),
    }
)
"""Strokes of letters in a box of width and height 1."""


def pen_motion(scene: Scene, rng: np.random.Generator) -> tuple[str, list[Leg]]:
    """A pen writes three letters or draws a line: a wave, a zigzag, or a few strokes.

    Args:
        scene: Its first tool is the pen, its first body the board.
        rng: Where random numbers come from.

    Returns:
        What is written, and the motion.
    """
    board, pen = scene.bodies[0], scene.tools[0]
    length, depth_of_board = 2.0 * board.half_extents[0] - 0.16, 2.0 * board.half_extents[2] - 0.1
    reach = 0.5 * getattr(pen, "height", 0.0) + getattr(pen, "radius", 0.03)
    pen_height = board.position[1] + board.half_extents[1] + reach + 0.001
    depth, scale = float(rng.uniform(0.03, 0.04)), pen.action_scale[0]
    kind = str(rng.choice(["word", "wave", "zigzag", "strokes"], p=[0.4, 0.2, 0.2, 0.2]))
    if kind == "word":
        kind = "".join(rng.choice(list(ALPHABET), 3, replace=False))
        width = (length - 2 * LETTER_GAP) / 3
        boxes = [(number * (width + LETTER_GAP), width, ALPHABET[letter]) for number, letter in enumerate(kind)]
    else:
        boxes = [(0.0, length, {"wave": _wave, "zigzag": _zigzag, "strokes": _strokes}[kind](rng))]
    left, top = board.position[0] - 0.5 * length, board.position[2] - 0.5 * depth_of_board
    lines = [
        [(left + begin + x * width, top + z * depth_of_board) for x, z in line] for begin, width, drawn in boxes for line in drawn
    ]
    return f"pen: {kind}", draw(lines, pen_height=pen_height, depth=depth, scale=scale)


def _wave(rng: np.random.Generator) -> tuple[Polyline, ...]:
    turns, phase = rng.uniform(0.8, 1.7), rng.uniform(0.0, 2.0 * math.pi)
    return (tuple((float(x), 0.5 + 0.5 * math.sin(2.0 * math.pi * turns * x + phase)) for x in np.linspace(0.0, 1.0, 25)),)


def _zigzag(rng: np.random.Generator) -> tuple[Polyline, ...]:
    corners = int(rng.integers(4, 6))
    first = int(rng.integers(2))
    return (tuple((number / (corners - 1), float((number + first) % 2)) for number in range(corners)),)


def _strokes(rng: np.random.Generator) -> tuple[Polyline, ...]:
    count = int(rng.integers(2, 5))
    columns = (np.arange(count) + 0.5) / count
    lines = []
    for middle in columns:
        half = rng.uniform(0.15, 0.3) / count
        lean = rng.uniform(-1.0, 1.0)
        lines.append(((float(middle - half * lean), 0.0), (float(middle + half * lean), float(rng.uniform(0.6, 1.0)))))
    return tuple(lines)


def dent_motion(scene: Scene, rng: np.random.Generator) -> tuple[str, list[Leg]]:
    """A ball presses 3 to 5 dents into the top and the sides of a block, apart from one another.

    They are 0.05 to 0.085 deep, a little less once the ball is away.

    Args:
        scene: Its first tool is the ball, its first body the block.
        rng: Where random numbers come from.

    Returns:
        A description, and the motion.

    Raises:
        InputError: The first tool is no ball.
    """
    block, ball = scene.bodies[0], scene.tools[0]
    if not isinstance(ball, ToolSphere):
        raise InputError("scene.tools.0", came=f"a {ball.kind}", expected="a Sphere, the ball")
    contacts: list[list[float]] = []
    legs: list[Leg] = []
    count = int(rng.integers(3, 6))
    steps, scale = 6, ball.action_scale[0]
    for _ in range(200):
        contact, inward = _contact(block, rng)
        way = CLEAR + float(rng.uniform(0.05, 0.085))
        start = [c - i * (ball.radius + CLEAR) for c, i in zip(contact, inward, strict=True)]
        bounds = zip(start, ball.lower_bound, ball.upper_bound, strict=True)
        close = [np.linalg.norm(np.subtract(contact, other)) < 2.6 * ball.radius for other in contacts]
        if any(close) or not all(low <= value <= high for value, low, high in bounds):
            continue
        contacts.append(contact)
        x, y, z = (way / steps / scale * part for part in inward)
        legs += [Leg(steps, {0: (x, y, z)}, {0: (start[0], start[1], start[2])}), Leg(steps, {0: (-x, -y, -z)})]
        if len(contacts) == count:
            break
    return f"{len(contacts)} dents", legs


def _contact(block: Body, rng: np.random.Generator) -> tuple[list[float], Vector3]:
    """A place on the top or a side of a block, and the direction into it."""
    faces: tuple[Vector3, ...] = ((0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, 0.0, -1.0))
    inward = faces[rng.integers(len(faces))]
    contact = [
        middle - way * half if way else middle + float(rng.uniform(-0.6, 0.6)) * half
        for middle, half, way in zip(block.position, block.half_extents, inward, strict=True)
    ]
    return contact, inward


def script_motion(scene: Scene, name: str, rng: np.random.Generator) -> list[Leg]:
    """A motion of a shipped script with numbers between those of its shipped variants.

    Args:
        scene: The scene of the task.
        name: A key of `cpdeform.tasks.single_stage.SCRIPTS`.
        rng: Where random numbers come from.
    """
    script, variants = SCRIPTS[name]
    return [_feasible(leg) for leg in script(scene, *_between(variants, rng))]


def _feasible(leg: Leg) -> Leg:
    """A leg of the same way with actions in [-1, 1]: a long way that was drawn with few steps takes more of them."""
    fastest = max((abs(value) for action in leg.actions.values() for value in action), default=0.0)
    if fastest <= 1.0:
        return leg
    steps = math.ceil(leg.steps * fastest)
    actions = {index: [value * leg.steps / steps for value in action] for index, action in leg.actions.items()}
    return dataclasses.replace(leg, steps=steps, actions=actions)


def _between(variants: Sequence[Any], rng: np.random.Generator) -> Any:
    """A nested tuple of numbers, each between the least and the largest in its place among the variants; steps stay whole."""
    first = variants[0]
    if isinstance(first, tuple):
        return tuple(_between(entries, rng) for entries in zip(*variants, strict=True))
    if all(isinstance(value, int) for value in variants):
        return int(rng.integers(min(variants), max(variants) + 1))
    return float(rng.uniform(min(variants), max(variants)))
