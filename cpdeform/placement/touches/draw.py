"""Random touches: contacts where transport has far to go, motions of the size of clay and tools."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from numpy.typing import NDArray

from cpdeform.placement.touches.drag import TouchDrag
from cpdeform.placement.touches.pinch import TouchPinch
from cpdeform.placement.touches.push import TouchPress, TouchPush
from cpdeform.placement.touches.stroke import TouchStroke
from cpdeform.placement.touches.together import TouchTogether
from cpdeform.placement.touches.touch import Touch, Vector

KINDS = ("push", "press", "drag", "none")
SHARES = (0.45, 0.3, 0.15, 0.1)
"""What a single tool does, and how often."""

STROKE_SHARE = 0.4
"""How often the only tool, a ball or a pen, draws a stroke instead."""

PINCH_SHARE = 0.4
"""How often two tools pinch instead of each doing something of its own."""

LONGEST_WAY = 0.45
"""The longest way of a tool, in edges of a cube of the clay's volume."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class TouchDraw:
    """Draws touches.

    Attributes:
        particles: All particles (N, 3), length units.
        displacements: Where transport moves each of them (N, 3), length units.
        tools: Indices of the movable tools.
        reach: The longest way of a tool, length units.
        generator: Source of randomness.
        strokes: Whether the only tool may draw strokes.
    """

    particles: NDArray[np.float64]
    displacements: NDArray[np.float64]
    tools: tuple[int, ...]
    reach: float
    generator: np.random.Generator
    strokes: bool = False

    def draw(self) -> Touch:
        """A touch of one or several tools."""
        if len(self.tools) >= 2 and self.generator.random() < PINCH_SHARE:
            first, second = self.generator.permutation(self.tools)[:2].tolist()
            return self._pinch((first, second))
        if self.strokes and self.generator.random() < STROKE_SHARE:
            return self._stroke(self.tools[0])
        parts: list[Touch] = []
        while not parts:
            drawn = [self._single(tool) for tool in self.tools]
            parts = [part for part in drawn if part is not None]
        return parts[0] if len(parts) == 1 else TouchTogether(parts=tuple(parts))

    def _single(self, tool: int) -> Touch | None:
        generator = self.generator
        kind = str(generator.choice(KINDS, p=SHARES))
        if kind == "press":
            contact, _ = self._contact(np.clip(-self.displacements[:, 1], 0.0, None))
            way, roll = self._way(0.05, 0.5), float(generator.uniform(0.0, math.pi))
            return TouchPress(tool=tool, contact=contact, direction=np.array([0.0, -1.0, 0.0]), way=way, roll=roll)
        if kind == "none":
            return None
        contact, direction = self._contact(np.linalg.norm(self.displacements, axis=1))
        if kind == "push":
            upright = generator.random() < 0.8
            roll = 0.2 * float(generator.standard_normal()) if upright else float(generator.uniform(0.0, math.pi))
            edge, way = bool(generator.random() < 0.5), self._way(0.12, 1.0)
            return TouchPush(tool=tool, contact=contact, direction=direction, way=way, edge=edge, roll=roll)
        any_side = generator.random() < 0.3
        side = float(generator.uniform(0.0, 2.0 * math.pi)) if any_side else float(generator.choice([0.0, math.pi]))
        closing = self._way(0.05, 0.4)
        return TouchDrag(tool=tool, contact=contact, direction=direction, way=self._way(0.4, 1.0), side=side, closing=closing)

    def _stroke(self, tool: int) -> TouchStroke:
        """From a place where the clay is to go down towards another one within reach."""
        lower = np.clip(-self.displacements[:, 1], 0.0, None)
        contact, direction = self._contact(lower)
        distances = np.linalg.norm((self.particles - contact)[:, [0, 2]], axis=1)
        weights = lower * (distances < self.reach) * (distances > 0.1 * self.reach)
        if weights.any():
            end, _ = self._contact(weights)
            direction = end - contact
        return TouchStroke(tool=tool, contact=contact, direction=direction, way=self._way(0.2, 1.0), depth=self._way(0.05, 0.5))

    def _pinch(self, tools: tuple[int, int]) -> TouchPinch:
        generator = self.generator
        contact, direction = self._contact(np.linalg.norm(self.displacements, axis=1))
        tilts = generator.uniform(-0.1, 0.6, 2)
        return TouchPinch(
            tools=tools,
            contact=contact,
            direction=direction,
            side=float(generator.uniform(0.0, 2.0 * math.pi)) if generator.random() < 0.3 else 0.0,
            tilts=(float(tilts[0]), float(tilts[1])),
            closings=(self._way(0.12, 0.9), self._way(0.12, 0.9)),
            pull=self._way(0.0, 1.0 if generator.random() < 0.3 else 0.6),
        )

    def _way(self, least: float, most: float) -> float:
        """A length between two parts of the reach."""
        return float(self.generator.uniform(least, most)) * self.reach

    def _contact(self, weights: NDArray[np.float64]) -> tuple[Vector, Vector]:
        """A particle, drawn by weight, and where transport moves it: half of the time on the level."""
        total = float(weights.sum())
        shares = weights / total if total > 0.0 else np.full(len(weights), 1.0 / len(weights))
        index = int(self.generator.choice(len(weights), p=shares))
        direction = self.displacements[index] * ([1.0, 0.0, 1.0] if self.generator.random() < 0.5 else [1.0, 1.0, 1.0])
        return self.particles[index], direction + 1e-4 * self.generator.standard_normal(3)
