"""Golden files: recorded rollouts and gradients, one ``.npz`` a scene.

A file holds x0, v0, F0, C0 (start), prim (tool states), actions, x, v (end), and total_loss and grad of PlasticineLab's objective
(nan where not recorded). Those recorded from PlasticineLab are named by the scene in its spelling and a version
(``torus-v2-seed0.npz``), and scenes and target grids are files of their own. Those that `cpdeform.testing.record_oracle` makes hold
the scene (as JSON) and goal_grid (G, G, G), too, and have any name.
"""

from __future__ import annotations

import dataclasses
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import ValidationError
from torch import Tensor

from cpdeform.core.bounded import MOST_STEPS
from cpdeform.core.errors import CapabilityError, InputError, brief
from cpdeform.core.goal import dense_grid
from cpdeform.core.reading.arrays import NUMBERS, ArrayFile, open_arrays
from cpdeform.core.reading.json_text import parse_json, read_json
from cpdeform.core.reading.limits import ReadingLimits
from cpdeform.core.reading.models import field_error
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

GRID_NAMES = ("goal_grid", "target_grid")
"""The goal's node masses in this project's own files: their name, and that of earlier versions."""


@dataclasses.dataclass(frozen=True)
class Golden:
    """A recorded rollout.

    Attributes:
        name: Name of the file without suffix.
        scene: Its scene.
        state: Its start, float64, a single world.
        arrays: All recorded arrays of numbers.
        goal_grid: Node masses (G, G, G) of the goal, float64; None where none is at hand.
    """

    name: str
    scene: Scene
    state: State
    arrays: dict[str, NDArray[np.float64]]
    goal_grid: Tensor | None

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


def read_golden(
    path: Path, *, scenes: Path | None = None, goals: Path | None = None, limits: ReadingLimits | None = None
) -> Golden:
    """Read a golden file.

    Args:
        path: The file.
        scenes: JSON file of scene definitions; defaults to ``plasticinelab/scenes.json`` beside the file's folder.
        goals: Target grids; defaults to ``plasticinelab/target_grids.npz`` beside the file's folder, if it exists.
        limits: How large the file may be; defaults to `cpdeform.core.reading.limits.default_limits`.

    Raises:
        InputError: A file is missing or too large, or its content does not fit.
        CapabilityError: The scene holds a tool that this version does not know.
    """
    with open_arrays(path, argument=str(path), expected="a golden file", limits=limits) as file:
        if "scene" in file:
            text = str(file.read("scene", shape=(), kinds="U", meaning="a scene as JSON"))
            scene = _scene(f"{path}: scene", _own_definition(path, text), file)
            arrays = _read_arrays(file, scene)
            shape = (scene.grid_size,) * 3
            name = next((name for name in GRID_NAMES if name in file), None)
            grid = None if name is None else torch.as_tensor(file.read(name, shape=shape))
        else:
            scene_name, grid_name = _names(path)
            beside = Path(os.path.realpath(path)).parent.parent / "plasticinelab"
            definition = _definition(scenes or beside / "scenes.json", scene_name)
            scene = _scene(f"{scenes or beside / 'scenes.json'}: {scene_name}", definition, file)
            arrays = _read_arrays(file, scene)
            grid = _goal_grid(goals, beside / "target_grids.npz", grid_name, scene)
    return Golden(path.stem, scene, recorded_start(scene, arrays), arrays, grid)


def _names(path: Path) -> tuple[str, str]:
    """Names of the scene's definition and of its target grid."""
    match = NAME_PATTERN.match(path.stem)
    if match is None or match["scene"] not in SCENES:
        raise InputError(str(path), came=f'the name "{path.stem}"', expected=f"a scene ({', '.join(SCENES)}) and -v with a number")
    scene, grid = SCENES[match["scene"]]
    return scene, f"{grid}-{match['version']}"


def _own_definition(path: Path, text: str) -> dict[str, Any]:
    """Fields of the scene that a golden file holds itself."""
    content = parse_json(text, argument=f"{path}: scene")
    if not isinstance(content, dict):
        raise InputError(f"{path}: scene", came=type(content).__name__, expected="the fields of a scene")
    return content


def _definition(path: Path, name: str) -> dict[str, Any]:
    """Fields of a scene, as they are defined."""
    content = read_json(path, argument=str(path))
    if not isinstance(content, dict) or not isinstance(content.get(name), dict):
        known = ", ".join(content) if isinstance(content, dict) else "definitions of scenes by name"
        raise InputError(str(path), came=f'no scene "{name}"', expected=f"one of {known}")
    return {key: value for key, value in content[name].items() if key != "variants"}


def _scene(source: str, fields: dict[str, Any], file: ArrayFile) -> Scene:
    """The scene with what the recording says about its discretisation."""
    recorded = {"softness": "softness", "substeps": "substeps", "dt": "time_step", "n_grid": "grid_size"}
    fields = fields | {field: file.read(key, shape=()).item() for key, field in recorded.items() if key in file}
    try:
        return Scene.model_validate(fields)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        if first["type"] == "union_tag_invalid" and first["loc"][0] == "tools":
            raise CapabilityError(brief(f"this version has no such tool: {first['msg']}", 300)) from error
        raise field_error(Scene, error, source=source) from error


def _read_arrays(file: ArrayFile, scene: Scene) -> dict[str, NDArray[np.float64]]:
    """All arrays of numbers; those that are used have the scene's shapes."""
    count, tools = scene.particle_count, sum(8 if hasattr(tool, "gap") else 7 for tool in scene.tools)
    shapes: dict[str, tuple[int | str, ...]] = dict.fromkeys(("x0", "v0", "x", "v"), (count, 3))
    shapes |= {"F0": (count, 3, 3), "C0": (count, 3, 3)}
    shapes |= {"actions": ("T", scene.action_size), "prim": ("T + 1", tools)}
    for name in shapes:
        if name not in file:
            expected = "x0, v0, F0, C0, prim, actions, x and v"
            raise InputError(file.argument, came=f'no array "{name}"', expected=expected)
    arrays = {name: file.read(name, shape=shape) for name, shape in shapes.items()}
    steps, times = len(arrays["actions"]), len(arrays["prim"])
    if not 1 <= steps <= MOST_STEPS or times != steps + 1:
        raise InputError(file.argument, came=f"{times} tool states for {steps} actions", expected="one more, at least 1 action")
    if float(np.abs(arrays["actions"]).max(initial=0.0)) > 1.0 + 1e-6:
        raise InputError(f"{file.argument}: actions", came="actions above 1", expected="actions in [-1, 1]")
    if min(arrays["x0"].min(), arrays["x"].min()) < 0.0 or max(arrays["x0"].max(), arrays["x"].max()) > 1.0:
        raise InputError(f"{file.argument}: x0, x", came="positions outside of the domain", expected="positions from 0 to 1")
    # Gradients that overflowed and losses that were not computed are recorded, too.
    others: dict[str, tuple[int | str, ...]] = {"total_loss": (), "grad": ("T", scene.action_size)}
    arrays |= {name: file.read(name, shape=shape, finite=False) for name, shape in others.items() if name in file}
    rest = {name: file.header(name) for name in file.names if name not in arrays}
    arrays |= {name: file.read(name, shape=None, finite=False) for name, header in rest.items() if header.dtype.kind in NUMBERS}
    return {name: values.astype(np.float64) for name, values in arrays.items()}


def recorded_poses(scene: Scene, recorded: NDArray[np.float64]) -> Tensor:
    """Tool poses (T+1, M, 8), float64, of recorded ones (T+1, numbers): 7 numbers a tool, 8 for one with a gap."""
    poses = torch.zeros(recorded.shape[0], len(scene.tools), 8, dtype=torch.float64)
    first = 0
    for index, tool in enumerate(scene.tools):
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


def _goal_grid(given: Path | None, beside: Path, name: str, scene: Scene) -> Tensor | None:
    if given is None and not beside.is_file():
        return None
    path = given or beside
    argument = f"{path}: {name}"
    with open_arrays(path, argument=str(path), expected="an .npz file of target grids") as file:
        if f"{name}/cells" not in file:
            return None
        cells = file.read(f"{name}/cells", shape=("K", 3), kinds="ui", meaning="node indices")
        count = file.read(f"{name}/count", shape=("K",), meaning="masses")
    grid = dense_grid(cells, count.astype(np.float64), scene.grid_size, argument=argument)
    return torch.as_tensor(grid) * scene.particle_volume
