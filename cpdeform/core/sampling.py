"""Particles inside bodies."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cpdeform.core.scene import Scene


def sample_particles(scene: Scene) -> NDArray[np.float64]:
    """Sample the particles of all bodies, uniformly at random and reproducibly.

    Args:
        scene: The scene; `scene.sampling` and `scene.sampling_seed` fix the result.

    Returns:
        Positions (N, 3), length units, bodies one after the other.
    """
    # NumPy's legacy generator is what PlasticineLab draws from; its stream is frozen (NEP 19).
    make = np.random.RandomState if scene.sampling == "plasticinelab" else np.random.default_rng
    generator = make(scene.sampling_seed)
    parts = [body.sample(generator) for body in scene.bodies]
    lower, upper = scene.domain
    return np.clip(np.concatenate(parts), lower, upper)


def body_index(scene: Scene) -> NDArray[np.int32]:
    """Index (N,) of the body that each particle belongs to."""
    counts = [body.particle_count for body in scene.bodies]
    return np.repeat(np.arange(len(counts), dtype=np.int32), counts)


def solid_index(scene: Scene) -> NDArray[np.int32]:
    """Index (N,) of the solid that each particle belongs to at the scene's start.

    Bodies with particles nearer to each other than a grid cell are one: they share grid nodes, so that the simulator joins them.
    """
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import KDTree

    bodies = body_index(scene)
    positions = sample_particles(scene)
    trees = [KDTree(positions[bodies == body]) for body in range(len(scene.bodies))]
    joined = np.eye(len(trees), dtype=np.int8)
    for first, tree in enumerate(trees):
        for second in range(first):
            joined[first, second] = tree.count_neighbors(trees[second], 1.0 / scene.grid_size) > 0
    _, labels = connected_components(joined, directed=False)
    return np.asarray(labels, dtype=np.int32)[bodies]
