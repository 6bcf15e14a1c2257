"""Golden files: recorded rollouts and gradients, one ``.npz`` a scene.

A file holds x0, v0, F0, C0 (start), prim (tool states), actions, x, v (end), and total_loss and grad of PlasticineLab's objective
(nan where not recorded). Those recorded from PlasticineLab are named by the scene in its spelling and a version
(``torus-v2-seed0.npz``), and scenes and target grids are files of their own. Those that `cpdeform.testing.record_oracle` makes hold
the scene (as JSON) and target_grid (G, G, G), too, and have any name.
"""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import ValidationError
from torch import Tensor

from cpdeform.core.errors import CapabilityError, InputError
from cpdeform.core.scene import Scene
from cpdeform.core.state import State, elastic_strain_from_gradient

NAME_PATTERN = re.compile(r"(?P<scene>.+?)-(?P<version>v\d+)(?:[-.].*)?$")
SCENES: Mapping[str, tuple[str, str]] = {
    "assembly": ("assembly", "Assembly3D"),
    "chopsticks": ("chopsticks", "Chopsticks3D"),
    "move": ("move", "Move3D"),
    "multistage_airplane": ("airplane", "multistage_airplane"),
    "multistage_bottle": ("bottle", "multistage_bottle"),
    "multistage_chair": ("chair", "multistage_chair"),
    "multistage_move": ("move++", "multistage_move"),
    "multistage_rope": ("rope++", "multistage_rope"),
    "multistage_star": ("star", "multistage_star"),
    "multistage_writer": ("writer++", "multistage_writer"),
    "pinch": ("pinch", "Pinch3D"),
    "rollingpin": ("rolling-pin", "Rollingpin3D"),
    "rope": ("rope", "Rope3D"),
    "table": ("table", "Table3D"),
    "torus": ("torus", "Torus3D"),
    "triplemove": ("triple-move", "TripleMove3D"),
    "writer": ("writer", "Writer3D"),
}
"""PlasticineLab's name of a scene to the name of its definition and, before the version, of its target grid."""


@dataclasses.dataclass(frozen=True)
class Golden:
    """A recorded rollout.

    Attributes:
        name: Name of the file without suffix.
        scene: Its scene.
        state: Its start, float64, a single world.
        arrays: All recorded arrays of numbers.
        target_grid: Node masses (G, G, G) of the target, float64; None where none is at hand.
    """

    name: str
    scene: Scene
    state: State
    arrays: dict[str, NDArray[np.float64]]
    target_grid: Tensor | None

    @property
    def actions(self) -> Tensor:
        """Recorded actions (1, T, A)."""
        return torch.as_tensor(self.arrays["actions"]).unsqueeze(0)


def golden_files(directory: Path) -> list[Path]:
    """Golden files in a folder, in the order of their names.

    Raises:
        InputError: The folder is missing or holds none.
    """
    found = sorted(directory.glob("*.npz")) if directory.is_dir() else []
    if not found:
        raise InputError("directory", came=str(directory), expected="a folder with golden files, such as torus-v2-seed0.npz")
    return found


def read_golden(path: Path, *, scenes: Path | None = None, targets: Path | None = None) -> Golden:
    """Read a golden file.

    Args:
        path: The file.
        scenes: JSON file of scene definitions; ``plasticinelab/scenes.json`` beside the file's folder where absent.
        targets: Target grids; ``plasticinelab/target_grids.npz`` beside the file's folder where absent, if it exists.

    Raises:
        InputError: A file is missing, or its content does not fit.
        CapabilityError: The scene holds a manipulator that this version does not know.
    """
    try:
        with np.load(path) as file:
            own = str(file["scene"]) if "scene" in file else None
            arrays = {key: file[key].astype(np.float64) for key in file if key != "scene"}
        if own is not None:
            scene = _validated(json.loads(own), path, "scene")
            grid = torch.as_tensor(arrays["target_grid"]) if "target_grid" in arrays else None
        else:
            scene_name, grid_name = _names(path)
            beside = path.resolve().parent.parent / "plasticinelab"
            scene = _scene(scenes or beside / "scenes.json", scene_name, arrays)
            grid = _target_grid(targets, beside / "target_grids.npz", grid_name, scene)
        return Golden(path.stem, scene, recorded_start(scene, arrays), arrays, grid)
    except OSError as error:
        raise InputError(str(path), came=f"{error}", expected="a golden file with its scene definition") from error
    except KeyError as error:
        raise InputError(str(path), came=f"no array {error}", expected="x0, v0, F0, C0, prim, actions, x and v") from error


def _names(path: Path) -> tuple[str, str]:
    """Names of the scene's definition and of its target grid."""
    match = NAME_PATTERN.match(path.stem)
    if match is None or match["scene"] not in SCENES:
        raise InputError(str(path), came=f'the name "{path.stem}"', expected=f"a scene ({', '.join(SCENES)}) and -v with a number")
    scene, grid = SCENES[match["scene"]]
    return scene, f"{grid}-{match['version']}"


def _scene(path: Path, name: str, arrays: dict[str, NDArray[np.float64]]) -> Scene:
    content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    if name not in content:
        raise InputError(str(path), came=f'no scene "{name}"', expected=f"one of {', '.join(content)}")
    fields = {key: value for key, value in content[name].items() if key != "variants"}
    recorded = {
        "softness": ("softness", float),
        "substeps": ("substeps", int),
        "dt": ("time_step", float),
        "n_grid": ("grid_size", int),
    }
    fields |= {field: kind(arrays[key]) for key, (field, kind) in recorded.items() if key in arrays}
    return _validated(fields, path, name)


def _validated(fields: dict[str, Any], path: Path, name: str) -> Scene:
    try:
        return Scene.model_validate(fields)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        if first["type"] == "union_tag_invalid":
            raise CapabilityError(f"this version has no such manipulator: {first['msg']}") from error
        raise InputError(f"{path}: {name}", came=f"{first['loc']}: {first['msg']}", expected="a scene") from error


def recorded_poses(scene: Scene, recorded: NDArray[np.float64]) -> Tensor:
    """Tool poses (T+1, M, 8), float64, of recorded ones (T+1, numbers): 7 numbers a tool, 8 for one with a gap."""
    poses = torch.zeros(recorded.shape[0], len(scene.manipulators), 8, dtype=torch.float64)
    first = 0
    for index, tool in enumerate(scene.manipulators):
        width = 8 if hasattr(tool, "gap") else 7
        poses[:, index, :width] = torch.as_tensor(recorded[:, first : first + width])
        first += width
    return poses


def recorded_start(scene: Scene, arrays: dict[str, NDArray[np.float64]]) -> State:
    """Start of a recorded rollout, float64, a single world, from x0, v0, F0, C0 and the first tool states of prim."""
    position, velocity, affine = (torch.as_tensor(arrays[key]).unsqueeze(0) for key in ("x0", "v0", "C0"))
    strain = elastic_strain_from_gradient(torch.as_tensor(arrays["F0"])).unsqueeze(0)
    poses = recorded_poses(scene, arrays["prim"][:1])
    # Some starts are recorded as written in PlasticineLab's tables (0.707, 0.707, 0, 0); it normalises as soon as a tool moves.
    poses[..., 3:7] /= poses[..., 3:7].norm(dim=-1, keepdim=True)
    return State(position, velocity, affine, strain, poses)


def _target_grid(given: Path | None, beside: Path, name: str, scene: Scene) -> Tensor | None:
    if given is None and not beside.is_file():
        return None
    with np.load(given or beside) as file:
        if f"{name}/cells" not in file:
            return None
        cells, count = file[f"{name}/cells"], file[f"{name}/count"]
    grid = torch.zeros((scene.grid_size,) * 3, dtype=torch.float64)
    grid[tuple(torch.as_tensor(cells.astype(np.int64)).T)] = torch.as_tensor(count.astype(np.float64)) * scene.particle_volume
    return grid
