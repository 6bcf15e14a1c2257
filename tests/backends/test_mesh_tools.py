"""Tools from meshes that copy a ball, a block and a capsule move the clay as these do, and their gradients point the same way."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from cpdeform.core.errors import MissingExtraError
from cpdeform.core.meshes.grid import make_grid, write_shape
from cpdeform.core.meshes.mesh import Mesh
from cpdeform.core.plugins import load_registry
from cpdeform.core.scene import Scene

trimesh = pytest.importorskip("trimesh")
pytest.importorskip("igl")

BODY = {"kind": "box", "position": (0.5, 0.1, 0.5), "widths": (0.2, 0.1, 0.2), "particle_count": 800}
# At a height of 0.2 the block's lower face would come to lie on nodes of the grid, where its distance has two gradients.
PLACE = {
    "position": (0.47, 0.2013, 0.52),
    "rotation_wxyz": (0.96, 0.0, 0.28, 0.0),
    "action_scale": (0.02, 0.02, 0.02, 0.2, 0.2, 0.2),
}
PRIMITIVES: dict[str, dict[str, Any]] = {
    "Sphere": {"radius": 0.05},
    "Box": {"half_extents": (0.05, 0.04, 0.06)},
    "Capsule": {"radius": 0.04, "height": 0.04},
}


def copy_of(kind: str) -> Mesh:
    if kind == "Sphere":
        made = trimesh.creation.icosphere(subdivisions=4, radius=0.05)
    elif kind == "Box":
        made = trimesh.creation.box((0.1, 0.08, 0.12))
    else:
        made = trimesh.creation.capsule(height=0.04, radius=0.04, count=[64, 64])
    mesh = Mesh(np.array(made.vertices), np.array(made.faces, dtype=np.int64))
    return mesh.turned("z") if kind == "Capsule" else mesh


def pressed(name: str, tool: dict[str, Any]) -> tuple[Tensor, Tensor]:
    """Positions (5, N, 3) and the gradient (4, 6) of the actions of a way that goes down, aside and turns."""
    content = {"bodies": [BODY], "tools": [{**tool, **PLACE}], "grid_size": 48, "substeps": 8, "ground_friction": 2.0}
    try:
        simulator = load_registry().create("simulator", name, scene=Scene.model_validate(content))
    except MissingExtraError as error:
        pytest.skip(str(error))
    actions = torch.zeros(1, 4, 6)
    actions[0, :, 1], actions[0, 2:, 0], actions[0, 2:, 4] = -1.0, 0.7, 0.5
    state = simulator.initial_state()
    trajectory = simulator.rollout(state, actions)
    gradient = torch.zeros_like(trajectory.positions)
    gradient[:, -1] = trajectory.positions[:, -1] - state.position - torch.tensor([0.03, -0.01, 0.02])
    return trajectory.positions[0].double(), simulator.vjp(trajectory, gradient).actions[0].double()


@pytest.mark.parametrize("kind", PRIMITIVES)
@pytest.mark.parametrize("name", ["native", "warp", pytest.param("taichi", marks=pytest.mark.slow)])
def test_a_copy_of_a_primitive_acts_as_it_does(name: str, kind: str, tmp_path: Path) -> None:
    if name not in load_registry().names("simulator"):
        pytest.skip(f"{name} is not installed")
    write_shape(tmp_path / "copy.npz", make_grid(copy_of(kind)))
    positions, gradient = pressed(name, {"kind": kind, **PRIMITIVES[kind]})
    copied, along = pressed(name, {"kind": "Mesh", "file": str(tmp_path / "copy.npz")})
    assert float((positions[-1] - positions[0]).norm(dim=-1).max()) > 0.02
    # A block has triangles for its faces; the facets of round copies are smoothed.
    distance, cosine = (1e-5, 0.9999) if kind == "Box" else (1e-3, 0.99)
    assert float((copied - positions).norm(dim=-1).max()) < distance
    assert float((gradient * along).sum() / (gradient.norm() * along.norm())) > cosine
