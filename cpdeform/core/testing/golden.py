"""Holds a simulator against golden files: rollouts and gradients recorded from PlasticineLab, one ``.npz`` a scene.

A file holds x0, v0, F0, C0 (start), prim (tool states), actions, x, v (end), and total_loss and grad of PlasticineLab's objective
(nan where not recorded). Its name begins with the scene in PlasticineLab's spelling and a version: ``torus-v2-seed0.npz``.
"""

from __future__ import annotations

import dataclasses
import json
import re
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import ValidationError
from torch import Tensor

from cpdeform.core.errors import CapabilityError, CpdeformError, InputError
from cpdeform.core.objectives.plasticinelab import ObjectivePlasticineLab
from cpdeform.core.scene import Scene
from cpdeform.core.simulator import Simulator, Trajectory
from cpdeform.core.state import State, elastic_strain_from_gradient
from cpdeform.core.testing.simulator_bench import SimulatorFactory

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

POSITION_BOUND, VELOCITY_BOUND, COSINE_BOUND, NORM_BOUND = 1e-4, 1e-2, 0.999, 0.02
OVERFLOW = 1e100
"""Recorded gradients above this are overflows of PlasticineLab (a rolling pin's, from rest) and not compared."""


@dataclasses.dataclass(frozen=True)
class Golden:
    """A recorded rollout.

    Attributes:
        name: Name of the file without suffix.
        scene: Its scene.
        state: Its start, float64, a single world.
        arrays: All recorded arrays.
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


@dataclasses.dataclass(frozen=True)
class GoldenErrors:
    """How far a simulator is from a recorded rollout.

    Attributes:
        name: Name of the file without suffix.
        status: ``"passed"``, ``"failed"``, or ``"unsupported"`` where the simulator declares that it cannot run the scene.
        position_error: Largest error of a coordinate at the end, length units.
        velocity_error: Error of the final velocities, relative to their norm.
        pose_error: Largest error of a number of the tools' poses at any time; for information, it has no bound.
        gradient_cosine: Cosine between the gradients of the actions; None where none was recorded.
        gradient_norm_error: Relative error of the gradient's norm; None where none was recorded.
        loss_error: Relative error of the loss; None where no gradient was recorded.
        seconds: Wall time.
        reason: What is out of tolerance or not supported; empty for a passed file.
    """

    name: str
    status: Literal["passed", "failed", "unsupported"]
    position_error: float | None = None
    velocity_error: float | None = None
    pose_error: float | None = None
    gradient_cosine: float | None = None
    gradient_norm_error: float | None = None
    loss_error: float | None = None
    seconds: float = 0.0
    reason: str = ""

    def __str__(self) -> str:
        figures = {
            "position": self.position_error,
            "velocity": self.velocity_error,
            "pose": self.pose_error,
            "1 - cosine": None if self.gradient_cosine is None else 1.0 - self.gradient_cosine,
            "norm": self.gradient_norm_error,
            "loss": self.loss_error,
        }
        text = "  ".join(f"{name} {'-' if value is None else f'{value:.2g}'}" for name, value in figures.items())
        return f"{self.status:<12}{self.name:<32}{text}  {self.seconds:.1f} s" + (f"\n{'':<12}{self.reason}" if self.reason else "")


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
    scene_name, grid_name = _names(path)
    beside = path.resolve().parent.parent / "plasticinelab"
    try:
        with np.load(path) as file:
            arrays = {key: file[key].astype(np.float64) for key in file}
        scene = _scene(scenes or beside / "scenes.json", scene_name, arrays)
        grid = _target_grid(targets, beside / "target_grids.npz", grid_name, scene)
        return Golden(path.stem, scene, _start(scene, arrays), arrays, grid)
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


def _start(scene: Scene, arrays: dict[str, NDArray[np.float64]]) -> State:
    position, velocity, affine = (torch.as_tensor(arrays[key]).unsqueeze(0) for key in ("x0", "v0", "C0"))
    strain = elastic_strain_from_gradient(torch.as_tensor(arrays["F0"])).unsqueeze(0)
    return State(position, velocity, affine, strain, recorded_poses(scene, arrays["prim"][:1]))


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


def compare_golden(
    golden: Golden, factory: SimulatorFactory, *, device: torch.device | str = "cpu", dtype: torch.dtype | None = None
) -> GoldenErrors:
    """Run a recorded rollout and compare its end and, where recorded, the gradient of the actions.

    Args:
        golden: The recording.
        factory: Makes the simulator, see `SimulatorFactory`.
        device: Where to run.
        dtype: Floating-point type; the simulator's default where absent.
    """
    begin = time.perf_counter()
    try:
        simulator = factory(golden.scene, batch_size=1, device=device, dtype=dtype)
    except CapabilityError as error:
        return GoldenErrors(golden.name, "unsupported", reason=str(error))
    trajectory = simulator.rollout(golden.state, golden.actions)
    position = trajectory.final_state.position[0].double().cpu().numpy()
    velocity = trajectory.final_state.velocity[0].double().cpu().numpy()
    errors = GoldenErrors(
        name=golden.name,
        status="passed",
        position_error=float(np.abs(position - golden.arrays["x"]).max()),
        velocity_error=float(np.linalg.norm(velocity - golden.arrays["v"]) / np.linalg.norm(golden.arrays["v"])),
        pose_error=_pose_error(golden, trajectory),
    )
    if simulator.capabilities.differentiable:
        errors = dataclasses.replace(errors, **_gradient_errors(golden, simulator, trajectory))
    reason = ", ".join(_out_of_tolerance(errors))
    status: Literal["passed", "failed"] = "failed" if reason else "passed"
    return dataclasses.replace(errors, status=status, reason=reason, seconds=time.perf_counter() - begin)


def _pose_error(golden: Golden, trajectory: Trajectory) -> float:
    expected = recorded_poses(golden.scene, golden.arrays["prim"])
    found = trajectory.manipulator_poses[0].double().cpu()
    return float((found - expected).abs().max()) if expected.numel() else 0.0


def _gradient_errors(golden: Golden, simulator: Simulator, trajectory: Trajectory) -> dict[str, Any]:
    recorded = torch.as_tensor(golden.arrays["grad"]) if "grad" in golden.arrays else torch.empty(0)
    usable = torch.isfinite(recorded) & (recorded.abs() < OVERFLOW)
    if golden.target_grid is None or not bool(usable.any()):
        return {}
    objective = ObjectivePlasticineLab(golden.scene, golden.target_grid.to(device=simulator.device, dtype=simulator.dtype))
    result = objective.evaluate(trajectory)
    gradient = simulator.vjp(trajectory, result.grad_positions, result.grad_manipulators).actions[0].double().cpu()
    found, expected = gradient[usable], recorded[usable]
    total = float(golden.arrays["total_loss"])
    return {
        "gradient_cosine": float(torch.nn.functional.cosine_similarity(found, expected, dim=0)),
        "gradient_norm_error": abs(float(found.norm() / expected.norm()) - 1.0),
        "loss_error": abs(float(result.loss[0]) - total) / abs(total),
    }


def _out_of_tolerance(errors: GoldenErrors) -> list[str]:
    """What is out of tolerance; nan is."""
    tests = {
        f"position error above {POSITION_BOUND:g}": (errors.position_error, POSITION_BOUND),
        f"velocity error above {VELOCITY_BOUND:g}": (errors.velocity_error, VELOCITY_BOUND),
        f"gradient norm off by more than {NORM_BOUND:g}": (errors.gradient_norm_error, NORM_BOUND),
        f"gradient cosine below {COSINE_BOUND:g}": (
            None if errors.gradient_cosine is None else 1.0 - errors.gradient_cosine,
            1.0 - COSINE_BOUND,
        ),
    }
    return [text for text, (figure, bound) in tests.items() if figure is not None and not figure < bound]


def check_golden_file(
    path: Path,
    factory: SimulatorFactory,
    *,
    scenes: Path | None = None,
    targets: Path | None = None,
    device: torch.device | str = "cpu",
    dtype: torch.dtype | None = None,
) -> GoldenErrors:
    """Read a golden file and compare; see `read_golden` and `compare_golden`. Whatever is raised is a failure of this file."""
    try:
        return compare_golden(read_golden(path, scenes=scenes, targets=targets), factory, device=device, dtype=dtype)
    except CapabilityError as error:
        return GoldenErrors(path.stem, "unsupported", reason=str(error))
    except CpdeformError as error:
        return GoldenErrors(path.stem, "failed", reason=str(error))
    except Exception as error:
        return GoldenErrors(path.stem, "failed", reason=f"It raised {type(error).__name__}: {error}".replace("\n", " "))
