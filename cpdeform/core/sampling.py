"""Particles inside bodies."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cpdeform.core.scene import BodyBox, BodySphere, Scene


def _sample_box(body: BodyBox, generator: np.random.Generator) -> NDArray[np.float64]:
    offset = generator.uniform(-0.5, 0.5, (body.particle_count, 3))
    return np.asarray(body.position, dtype=np.float64) + offset * np.asarray(body.widths, dtype=np.float64)


def _sample_sphere(body: BodySphere, generator: np.random.Generator) -> NDArray[np.float64]:
    direction = generator.standard_normal((body.particle_count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    radius = body.radius * generator.uniform(0.0, 1.0, (body.particle_count, 1)) ** (1.0 / 3.0)
    return np.asarray(body.position) + radius * direction


def _sample_box_plasticinelab(body: BodyBox, generator: np.random.RandomState) -> NDArray[np.float64]:
    offset = 2.0 * generator.random_sample((body.particle_count, 3)) - 1.0
    return np.asarray(body.position, dtype=np.float64) + offset * (0.5 * np.asarray(body.widths, dtype=np.float64))


def _sample_sphere_plasticinelab(body: BodySphere, generator: np.random.RandomState) -> NDArray[np.float64]:
    direction = generator.standard_normal((body.particle_count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    radius = generator.random_sample((body.particle_count, 1)) ** (1.0 / 3.0)
    return np.asarray(body.position) + direction * radius * body.radius


def sample_particles(scene: Scene) -> NDArray[np.float64]:
    """Sample the particles of all bodies, uniformly at random and reproducibly.

    Args:
        scene: The scene; `scene.sampling` and `scene.sampling_seed` fix the result.

    Returns:
        Positions (N, 3), length units, bodies one after the other.
    """
    if scene.sampling == "plasticinelab":
        # NumPy's legacy generator is what PlasticineLab draws from, and its stream is frozen (NEP 19).
        legacy = np.random.RandomState(scene.sampling_seed)
        parts = [
            _sample_box_plasticinelab(body, legacy) if isinstance(body, BodyBox) else _sample_sphere_plasticinelab(body, legacy)
            for body in scene.bodies
        ]
    else:
        generator = np.random.default_rng(scene.sampling_seed)
        parts = [
            _sample_box(body, generator) if isinstance(body, BodyBox) else _sample_sphere(body, generator) for body in scene.bodies
        ]
    lower, upper = scene.domain
    return np.clip(np.concatenate(parts), lower, upper)


def body_index(scene: Scene) -> NDArray[np.int32]:
    """Index (N,) of the body that each particle belongs to."""
    counts = [body.particle_count for body in scene.bodies]
    return np.repeat(np.arange(len(counts), dtype=np.int32), counts)
