"""Reference trajectories of PlasticineLab, read from a folder beside the project; tests skip loudly where it is absent."""

from __future__ import annotations

import dataclasses
import json
import os
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from cpdeform.core.scene import Scene
from cpdeform.core.state import State, elastic_strain_from_gradient

SHARED = Path(os.environ.get("CPDEFORM_SHARED", Path(__file__).resolve().parents[2] / "shared"))
SCENES = {
    "assembly-v2": ("assembly", "Assembly3D-v2"),
    "move-v2": ("move", "Move3D-v2"),
    "chopsticks-v2": ("chopsticks", "Chopsticks3D-v2"),
    "multistage_airplane-v1": ("airplane", None),
    "multistage_star-v1": ("star", None),
    "pinch-v2": ("pinch", "Pinch3D-v2"),
    "rollingpin-v2": ("rolling-pin", "Rollingpin3D-v2"),
    "rope-v2": ("rope", "Rope3D-v2"),
    "table-v2": ("table", "Table3D-v2"),
    "torus-v2": ("torus", "Torus3D-v2"),
    "triplemove-v2": ("triple-move", "TripleMove3D-v2"),
    "writer-v2": ("writer", "Writer3D-v2"),
}
"""File name to scene name and name of the target grid (None where none was published)."""


@dataclasses.dataclass(frozen=True)
class Golden:
    """A recorded rollout.

    Attributes:
        scene: Its scene.
        state: Its start, float64, a single world.
        arrays: All recorded arrays, see the folder's own description.
        target_grid: Node masses (G, G, G) of the target; None where none was published.
    """

    scene: Scene
    state: State
    arrays: dict[str, NDArray[np.float64]]
    target_grid: torch.Tensor | None

    @property
    def actions(self) -> torch.Tensor:
        """Recorded actions (1, T, A)."""
        return torch.as_tensor(self.arrays["actions"]).unsqueeze(0)


def load_golden(name: str) -> Golden:
    """Read a recorded rollout, or skip the test where it is absent."""
    path = SHARED / "golden" / f"{name}-seed0.npz"
    if not path.exists():
        pytest.skip(f"no recorded trajectory {path.name} in {path.parent}; set CPDEFORM_SHARED to the folder that holds golden/")
    with np.load(path) as file:
        arrays = {key: file[key].astype(np.float64) for key in file}
    scene_name, grid_name = SCENES[name]
    content = json.loads((SHARED / "plasticinelab" / "scenes.json").read_text())[scene_name]
    content.pop("variants", None)
    scene = Scene.model_validate(content)
    tools = len(scene.manipulators)
    pose = torch.zeros(1, tools, 8, dtype=torch.float64)
    recorded = torch.as_tensor(arrays["prim"][0]).reshape(tools, -1)
    pose[0, :, : recorded.shape[1]] = recorded
    state = State(
        torch.as_tensor(arrays["x0"]).unsqueeze(0),
        torch.as_tensor(arrays["v0"]).unsqueeze(0),
        torch.as_tensor(arrays["C0"]).unsqueeze(0),
        elastic_strain_from_gradient(torch.as_tensor(arrays["F0"])).unsqueeze(0),
        pose,
    )
    return Golden(scene, state, arrays, None if grid_name is None else _target_grid(grid_name, scene))


def _target_grid(name: str, scene: Scene) -> torch.Tensor:
    with np.load(SHARED / "plasticinelab" / "target_grids.npz") as file:
        cells, count = file[f"{name}/cells"], file[f"{name}/count"]
    grid = torch.zeros((scene.grid_size,) * 3, dtype=torch.float64)
    grid[tuple(cells.astype(np.int64).T)] = torch.as_tensor(count, dtype=torch.float64) * scene.particle_volume
    return grid
