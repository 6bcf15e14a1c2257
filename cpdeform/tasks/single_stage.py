"""The goals of the single-stage tasks: scripted motions of the scene's tools over one episode."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from cpdeform.core.scene import Scene, Vector3
from cpdeform.core.simulator import Simulator
from cpdeform.tasks.scripts import Leg, perform

Array = NDArray[np.float64]

EPISODE = 50
"""Environment steps of PlasticineLab's tasks."""


def _velocity(scene: Scene, tool: int, way: Vector3, steps: int) -> tuple[float, float, float]:
    """The action that takes a tool along a way, length units, in a number of steps."""
    x, y, z = (part / steps / scale for part, scale in zip(way, scene.tools[tool].action_scale[:3], strict=True))
    return x, y, z


def _carried(scene: Scene, squeeze: float, ways: Sequence[Vector3], *, steps: int = 8) -> list[Leg]:
    """Pairs of tools to the left and right of bodies squeeze them along x, each tool by `squeeze`, and carry them along."""
    pairs = [((2 * number, 1.0), (2 * number + 1, -1.0)) for number in range(len(ways))]
    # In the scenes whose first tool is the right one of a pair the signs are the other way round.
    signs = [
        (tool, sign if scene.tools[pair[0][0]].position[0] < scene.tools[pair[1][0]].position[0] else -sign)
        for pair in pairs
        for tool, sign in pair
    ]
    grip = {tool: _velocity(scene, tool, (sign * squeeze, 0.0, 0.0), steps) for tool, sign in signs}
    rest = EPISODE - steps
    carry = {tool: _velocity(scene, tool, ways[number // 2], rest) for number, (tool, _) in enumerate(signs)}
    return [Leg(steps, grip), Leg(rest, carry)]


def _move(scene: Scene, way: Vector3) -> list[Leg]:
    return _carried(scene, 0.045, [way])


def _triple_move(scene: Scene, ways: Sequence[Vector3]) -> list[Leg]:
    return _carried(scene, 0.03, ways)


def _torus(scene: Scene, aside: tuple[float, float]) -> list[Leg]:
    """Over the place, down into the board, up again."""
    over = _velocity(scene, 0, (aside[0], -0.07, aside[1]), 20)
    return [Leg(20, {0: over}), Leg(16, {0: (0.0, -0.9, 0.0)}), Leg(14, {0: (0.0, 1.0, 0.0)})]


def _rope(scene: Scene, ways: Sequence[Vector3]) -> list[Leg]:
    """Both ends are pulled past the post, slowly enough for the rope to follow."""
    return [Leg(EPISODE, {tool: _velocity(scene, tool, way, EPISODE) for tool, way in enumerate(ways)})]


def _rolling_pin(scene: Scene, forth: float, turn: float) -> list[Leg]:
    """Pressed down while it rolls forth, then back over the starting place."""
    return [Leg(25, {0: (forth, turn, -1.0)}), Leg(25, {0: (-forth, 0.0, -0.3)})]


def _chopsticks(scene: Scene, way: Vector3, turn: float) -> list[Leg]:
    """Closed round the rod, then carried; `turn` about the vertical in radians."""
    grip = Leg(8, {0: (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.25)})
    steps = EPISODE - grip.steps
    about = turn / steps / scene.tools[0].action_scale[4]
    return [grip, Leg(steps, {0: (*_velocity(scene, 0, way, steps), 0.0, about, 0.0, 0.0)})]


def _assembly(scene: Scene, way: Vector3) -> list[Leg]:
    """The ball, squeezed, lifted, and laid onto the block."""
    grip = {0: _velocity(scene, 0, (-0.02, 0.0, 0.0), 6), 1: _velocity(scene, 1, (0.02, 0.0, 0.0), 6)}
    lift = {tool: _velocity(scene, tool, (0.0, way[1], 0.0), 18) for tool in range(2)}
    aside = {tool: _velocity(scene, tool, (way[0], 0.0, way[2]), 26) for tool in range(2)}
    return [Leg(6, grip), Leg(18, lift), Leg(26, aside)]


def _table(scene: Scene, way: Vector3) -> list[Leg]:
    """A leg is pushed outwards, slowly."""
    x, _, z = way
    scale = scene.tools[0].action_scale
    return [Leg(40, {0: (x / 40 / scale[0], 0.0, z / 40 / scale[2])}), Leg(10)]


PEN_HEIGHT = 0.161
"""Height of the pen's centre when its tip is 1/1000 above the board, length units."""


def _writer(scene: Scene, start: tuple[float, float], legs: Sequence[tuple[int, Vector3]]) -> list[Leg]:
    """A stroke over 10 steps, beside the pen's start."""
    first, *others = [Leg(steps, {0: action}) for steps, action in legs]
    return [Leg(first.steps, first.actions, {0: (start[0], PEN_HEIGHT, start[1])}), *others]


SCRIPTS: Mapping[str, tuple[Callable[..., list[Leg]], tuple[tuple[object, ...], ...]]] = MappingProxyType(
    {
        "move": (
            _move,
            (((0.05, 0.13, -0.12),), ((-0.1, 0.12, 0.1),), ((0.12, -0.1, -0.08),), ((0.0, 0.15, 0.15),), ((0.15, 0.1, 0.0),)),
        ),
        "triple-move": (
            _triple_move,
            (
                (((0.0, 0.08, 0.12), (0.0, 0.14, -0.12), (0.0, 0.08, 0.12)),),
                (((-0.08, 0.1, 0.0), (0.0, 0.1, 0.15), (0.08, 0.1, -0.08)),),
                (((0.0, 0.16, -0.1), (0.0, 0.08, 0.1), (0.0, 0.16, -0.1)),),
                (((-0.1, 0.06, -0.1), (0.0, 0.15, 0.0), (0.1, 0.06, 0.1)),),
                (((0.0, 0.06, 0.16), (0.0, 0.1, 0.08), (0.0, 0.14, 0.0)),),
            ),
        ),
        "torus": (_torus, (((0.06, 0.05),), ((-0.06, 0.04),), ((0.03, -0.07),), ((-0.05, -0.06),), ((0.0, 0.08),))),
        "rope": (
            _rope,
            (
                (((0.04, 0.0, -0.34), (-0.1, 0.0, -0.34)),),
                (((0.08, 0.0, -0.30), (-0.08, 0.0, -0.30)),),
                (((0.04, 0.0, -0.36), (-0.08, 0.0, -0.28)),),
                (((0.06, 0.0, -0.26), (-0.06, 0.0, -0.36)),),
                (((0.1, 0.0, -0.34), (-0.04, 0.0, -0.30)),),
            ),
        ),
        "rolling-pin": (_rolling_pin, ((0.25, 0.0), (-0.25, 0.3), (0.3, -0.3), (-0.3, -0.2), (0.2, 0.4))),
        "chopsticks": (
            _chopsticks,
            (
                ((0.06, 0.14, 0.06), 0.5),
                ((0.0, 0.16, 0.1), 0.0),
                ((0.08, 0.14, 0.0), -0.5),
                ((-0.08, 0.15, 0.0), 0.6),
                ((0.0, 0.15, -0.1), -0.4),
            ),
        ),
        "assembly": (
            _assembly,
            (((0.3, 0.165, 0.0),), ((0.27, 0.165, 0.03),), ((0.33, 0.165, -0.03),), ((0.3, 0.165, 0.04),), ((0.26, 0.165, -0.04),)),
        ),
        "table": (
            _table,
            (((0.1, 0.0, 0.1),), ((-0.1, 0.0, 0.1),), ((0.1, 0.0, -0.1),), ((-0.1, 0.0, -0.1),), ((0.11, 0.0, 0.08),)),
        ),
        "writer": (
            _writer,
            (
                ((0.40, 0.60), ((4, (0.3, -1.0, -0.4)), (6, (0.2, -0.3, -1.0)))),
                ((0.60, 0.60), ((4, (-0.4, -1.0, -0.3)), (6, (-1.0, -0.3, -0.2)))),
                ((0.50, 0.40), ((4, (-0.3, -1.0, 0.0)), (6, (-1.0, -0.3, 0.2)))),
                ((0.61, 0.55), ((4, (-0.2, -1.0, -0.4)), (6, (-0.3, -0.3, -1.0)))),
                ((0.42, 0.60), ((5, (0.2, -1.0, -0.2)), (5, (1.0, -0.2, -0.1)))),
            ),
        ),
    }
)
"""The script of each task and its arguments, a row a variant."""


def _scripted(
    script: Callable[..., list[Leg]], arguments: tuple[object, ...], scene: Scene, simulator: Callable[[], Simulator]
) -> Array:
    return perform(script(scene, *arguments), simulator())


SINGLE_STAGE: Mapping[str, tuple[Callable[[Scene, Callable[[], Simulator]], Array], bool]] = MappingProxyType(
    {
        f"{name}-v{number}": (functools.partial(_scripted, script, arguments), True)
        for name, (script, variants) in SCRIPTS.items()
        for number, arguments in enumerate(variants, start=1)
    }
)
"""The maker of each variant's goal; its particles are the body's own."""
