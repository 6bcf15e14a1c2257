"""Grids of points on surfaces of revolution."""

from __future__ import annotations

import numpy as np

from cpdeform.core.shapes.base import Array


def arc(radius: float, rows: int) -> Array:
    """The lower quarter of a circle's right half (rows, 2), from the pole up: distance from the axis and height, length units."""
    angle = np.linspace(-0.5 * np.pi, 0.0, rows)
    return np.stack([np.cos(angle), np.sin(angle)], axis=1) * radius


def mirrored(lower: Array) -> Array:
    """A profile's lower half (K, 2) and its mirror image above."""
    return np.concatenate([lower, (lower * [1.0, -1.0])[::-1]])


def revolve(profile: Array, *, rows: int, columns: int) -> Array:
    """Turn a profile (K, 2) of distances from the y axis and heights about that axis into points (rows, columns, 3)."""
    # Even spacing along the curve keeps the cells of the mesh of about one size.
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(profile, axis=0), axis=1))])
    even = np.linspace(0.0, length[-1], rows)
    radius, height = (np.interp(even, length, profile[:, axis])[:, None] for axis in range(2))
    angle = np.linspace(0.0, 2.0 * np.pi, columns)
    return np.stack([radius * np.cos(angle), height + 0.0 * angle, radius * np.sin(angle)], axis=-1)
