"""The goals of the multi-stage tasks."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from cpdeform.core.scene import Scene
from cpdeform.core.simulator import Simulator
from cpdeform.tasks import sculptures
from cpdeform.tasks.letters import write
from cpdeform.tasks.rearrangements import bent_rope, shifted_bodies
from cpdeform.tasks.scripts import Leg, perform
from cpdeform.tasks.solids import Solid

Array = NDArray[np.float64]

Maker = Callable[[Scene, Callable[[], Simulator]], Array]
"""Makes particles (N, 3), length units, from a scene and a way to get its simulator in float64."""

CUBE_SHIFTS = ((0.06, 0.0, 0.15), (0.02, 0.0, -0.17), (-0.08, 0.0, 0.13))

ROPE_HEADINGS = tuple(math.radians(angle) for angle in (40.0, -25.0, -35.0, 30.0))

DENTS = (
    Leg(5, {0: (0.0, -0.9, 0.0)}, {0: (0.46, 0.243, 0.46)}),
    Leg(5, {0: (0.8, 0.0, 0.0)}, {0: (0.357, 0.12, 0.55)}),
    Leg(5, {0: (-0.8, 0.0, 0.0)}, {0: (0.643, 0.13, 0.47)}),
    Leg(5, {0: (0.0, 0.0, -0.8)}, {0: (0.53, 0.12, 0.643)}),
    Leg(10, {}, {0: (0.5, 0.35, 0.5)}),
)
"""A ball presses into a block from above and from three sides."""


def _solid(make: Callable[[], Solid]) -> Maker:
    return lambda scene, simulator: make().positions(scene)


def _letters(scene: Scene, simulator: Callable[[], Simulator]) -> Array:
    letters = {"left": 0.215, "top": 0.422, "width": 0.12, "height": 0.156, "gap": 0.07}
    legs = write("ICLR", **letters, pen_height=0.161, depth=0.035, scale=scene.tools[0].action_scale[0])
    return perform(legs, simulator())


MULTI_STAGE: Mapping[str, tuple[Maker, bool]] = MappingProxyType(
    {
        "airplane": (_solid(sculptures.airplane), False),
        "chair": (_solid(sculptures.chair), False),
        "bottle": (_solid(sculptures.bottle), False),
        "star": (_solid(sculptures.star), False),
        "move++": (lambda scene, simulator: shifted_bodies(scene, CUBE_SHIFTS), True),
        "rope++": (lambda scene, simulator: bent_rope(scene, headings=ROPE_HEADINGS, corner_length=0.08), True),
        "writer++": (_letters, True),
        "pinch": (lambda scene, simulator: perform(DENTS, simulator()), True),
    }
)
"""The maker of each task's goal, and whether its particles are the body's own."""
