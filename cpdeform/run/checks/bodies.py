"""Bodies that come near are one to the simulator."""

from __future__ import annotations

import itertools
import math

from cpdeform.core.scene import Body, BodySphere, Scene
from cpdeform.run.checks.finding import Finding

KIND = "near bodies"
FREE_CELLS = 2.0
"""Cells between bodies beyond which they move freely: nearer ones share grid nodes, and a node has one velocity."""
JOINED_CELLS = 1.0
"""Cells below which they share most of their nodes and act as one, see `cpdeform.core.sampling.solid_index`."""


def check_near_bodies(scene: Scene) -> list[Finding]:
    """Tell of bodies that start with a gap so narrow that they stick to each other. Bodies that touch are plainly meant as one."""
    joined: dict[tuple[int, int], float] = {}
    near: dict[tuple[int, int], float] = {}
    for (first, body), (second, other) in itertools.combinations(enumerate(scene.bodies), 2):
        cells = gap(body, other) / scene.node_distance
        if 1e-6 < cells < FREE_CELLS:
            (joined if cells < JOINED_CELLS else near)[first, second] = cells
    free = f"Leave {FREE_CELLS:g} cells ({FREE_CELLS * scene.node_distance:.3g}) between bodies that are to move freely"
    findings = []
    if joined:
        what = "They act as one body and do not come apart: they share grid nodes, and a node has one velocity."
        findings.append(Finding("note", KIND, "scene.bodies", f"{_listed(joined)}. {what}", f"{free}; keep them if one is meant."))
    if near:
        what = "They will stick to each other: they share grid nodes, and a node has one velocity."
        findings.append(Finding("warning", KIND, "scene.bodies", f"{_listed(near)}. {what}", f"{free}."))
    return findings


def _listed(pairs: dict[tuple[int, int], float]) -> str:
    """The pairs of bodies and how many cells are between them."""
    return ", ".join(f"{first} and {second} start {cells:.2g} grid cells apart" for (first, second), cells in pairs.items())


def gap(first: Body, second: Body) -> float:
    """Distance between two bodies' surfaces, length units; 0 where they touch or overlap."""
    between = [abs(a - b) for a, b in zip(first.position, second.position, strict=True)]
    halves = [_core(first)[axis] + _core(second)[axis] for axis in range(3)]
    apart = math.hypot(*(max(0.0, distance - half) for distance, half in zip(between, halves, strict=True)))
    return max(0.0, apart - _rounding(first) - _rounding(second))


def _core(body: Body) -> tuple[float, float, float]:
    """Half extents of a box (of that around a mesh), or of the point that a ball is grown from, length units."""
    return (0.0, 0.0, 0.0) if isinstance(body, BodySphere) else body.half_extents


def _rounding(body: Body) -> float:
    return body.radius if isinstance(body, BodySphere) else 0.0
