"""A goal that clay does not keep: it tips over, sags or falls apart as soon as the tools are away."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from cpdeform.core.errors import PluginError
from cpdeform.core.plugins import AUTO, Registry, load_registry
from cpdeform.core.scene import Scene
from cpdeform.planning.rest import rest_scene, settle_goal
from cpdeform.run.checks.finding import Finding

SAMPLE = 5000
"""Particles that the goal is let go with: dense enough to hold together as clay, and quick."""

KEPT_CELLS = 2.0
"""Grid cells that a particle may move in the goal's frame and still count as kept."""

LEAST_MOVED = 0.1
"""Share of particles that move farther from which on it is worth telling."""

STEP_LIMIT = 200
"""Environment steps to watch: what has not fallen by then does not."""


def check_goal_rest(scene: Scene, goal: NDArray[np.float64], *, registry: Registry | None = None) -> list[Finding]:
    """Let the goal (M, 3), length units, go as clay without movable tools, and tell of one that does not stay as it is.

    Args:
        scene: Material, floor and fixed tools.
        goal: Goal particles.
        registry: Where a simulator is looked up; defaults to the installed plugins. Without one nothing is told.
    """
    registry = registry or load_registry()
    try:
        name = registry.resolve("simulator", AUTO, device="cpu")
    except PluginError:
        return []
    chosen = np.random.default_rng(0).permutation(len(goal))[:SAMPLE]
    if len(chosen) < len(scene.bodies):
        # Clay has at least a particle for each body: too few to tell anything.
        return []
    # So few particles are not worth more than one thread.
    threads = {"threads": 1} if "threads" in (registry.option_names("simulator", name) or ()) else {}
    scene_at_rest = rest_scene(scene, particle_count=len(chosen))
    simulator = registry.create("simulator", name, scene=scene_at_rest, dtype=torch.float32, **threads)
    settled = settle_goal(simulator, torch.as_tensor(goal[chosen], dtype=torch.float32), step_limit=STEP_LIMIT)
    if not bool(torch.isfinite(settled.let_go).all()):
        # A sample may be too thin to hold together where the goal itself does: nothing follows.
        return []
    ways = torch.linalg.vector_norm(settled.let_go - settled.position, dim=1) / scene.node_distance
    moved = ways > KEPT_CELLS
    share = float(moved.float().mean())
    if share < LEAST_MOVED:
        return []
    return [
        Finding(
            "note",
            "goal at rest",
            "goal",
            f"Let go as clay, the goal does not keep its shape: {share:.0%} of it moves by more than {KEPT_CELLS:g} cells, "
            f"and 95% of it by at most {float(ways.quantile(0.95)) * scene.node_distance:.2g}.",
            "Lay it on a broader side, or make thin parts thicker; keep it if the tools are to hold it.",
        )
    ]
