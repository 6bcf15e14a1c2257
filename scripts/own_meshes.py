"""Three meshes as somebody might have them: `python scripts/own_meshes.py FOLDER`."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import trimesh

FILES = {"bowl": "bowl.stl", "heart": "heart.obj", "mug": "mug.glb"}
UPWARDS = {"heart": "z"}
"""What `cpdeform task new` has to be told: most OBJ files have y upwards, this one has z."""


def write_meshes(folder: Path) -> None:
    """Write all of `FILES`."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, make in {"bowl": bowl, "heart": heart, "mug": mug}.items():
        make().export(folder / FILES[name])


def bowl() -> trimesh.Trimesh:
    """A profile turned about z, centimetres."""
    outside = [[0, 0], [6, 0], [8, 2.5], [9.5, 5.5], [10, 8]]
    inside = [[7.2, 8], [6.6, 5.5], [5, 3.6], [3, 2.8], [0, 2.5]]
    return trimesh.creation.revolve(np.array(outside + inside), sections=96)


def heart() -> trimesh.Trimesh:
    """A plane curve blown up, millimetres; the triangles at its two poles have no area."""
    around, across = np.meshgrid(np.linspace(0, 2 * np.pi, 80, endpoint=False), np.linspace(0, np.pi, 40), indexing="ij")
    high = 13 * np.cos(around) - 5 * np.cos(2 * around) - 2 * np.cos(3 * around) - np.cos(4 * around)
    curve = np.stack([16 * np.sin(around) ** 3, high], axis=-1) * np.sin(across)[..., None]
    points = np.concatenate([curve, 7 * np.cos(across)[..., None]], axis=-1).reshape(-1, 3)
    first = np.arange(80 * 40).reshape(80, 40)
    here, beside = first[:, :-1].ravel(), np.roll(first, -1, axis=0)[:, :-1].ravel()
    corners = [np.stack([here, beside, beside + 1], axis=-1), np.stack([here, beside + 1, here + 1], axis=-1)]
    return trimesh.Trimesh(points, np.concatenate(corners), process=False)


def mug() -> trimesh.Scene:
    """Wall, bottom and handle, which overlap, metres, y upwards."""
    wall = trimesh.creation.annulus(r_min=0.03, r_max=0.045, height=0.09)
    bottom = trimesh.creation.cylinder(radius=0.04, height=0.015)
    bottom.apply_translation([0, 0, -0.0375])
    ring = trimesh.creation.torus(major_radius=0.026, minor_radius=0.008)
    ring.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0]))
    ring.apply_translation([0.05, 0, 0])
    scene = trimesh.Scene([wall, bottom, ring])
    scene.apply_transform(trimesh.transformations.rotation_matrix(-np.pi / 2, [1, 0, 0]))
    return scene


if __name__ == "__main__":
    write_meshes(Path(sys.argv[1]))
