"""Holds a simulator against golden files, see `cpdeform.testing.golden_file`."""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from cpdeform.core.errors import CapabilityError, CpdeformError
from cpdeform.core.simulator import Simulator, Trajectory
from cpdeform.planning.objectives.plasticinelab import ObjectivePlasticineLab
from cpdeform.testing.golden_file import Golden, read_golden, recorded_poses
from cpdeform.testing.simulator_bench import SimulatorFactory

POSITION_BOUND, VELOCITY_BOUND, COSINE_BOUND, NORM_BOUND = 1e-4, 1e-2, 0.999, 0.02
OVERFLOW = 1e100
"""Recorded gradients above this are overflows of PlasticineLab (a rolling pin's, from rest) and not compared."""


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


def compare_golden(
    golden: Golden, factory: SimulatorFactory, *, device: torch.device | str = "cpu", dtype: torch.dtype | None = None
) -> GoldenErrors:
    """Run a recorded rollout and compare its end and, where recorded, the gradient of the actions.

    Args:
        golden: The recording.
        factory: Makes the simulator, see `SimulatorFactory`.
        device: Where to run.
        dtype: Floating-point type; defaults to the simulator's default.
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
    found = trajectory.tool_poses[0].double().cpu()
    return float((found - expected).abs().max()) if expected.numel() else 0.0


def _gradient_errors(golden: Golden, simulator: Simulator, trajectory: Trajectory) -> dict[str, Any]:
    recorded = torch.as_tensor(golden.arrays["grad"]) if "grad" in golden.arrays else torch.empty(0)
    usable = torch.isfinite(recorded) & (recorded.abs() < OVERFLOW)
    if golden.goal_grid is None or not bool(usable.any()):
        return {}
    objective = ObjectivePlasticineLab(golden.scene, golden.goal_grid.to(device=simulator.device, dtype=simulator.dtype))
    result = objective.evaluate(trajectory)
    gradient = simulator.vjp(trajectory, result.grad_positions, result.grad_tools).actions[0].double().cpu()
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
    goals: Path | None = None,
    device: torch.device | str = "cpu",
    dtype: torch.dtype | None = None,
) -> GoldenErrors:
    """Read a golden file and compare; see `read_golden` and `compare_golden`. Whatever is raised is a failure of this file."""
    try:
        return compare_golden(read_golden(path, scenes=scenes, goals=goals), factory, device=device, dtype=dtype)
    except CapabilityError as error:
        return GoldenErrors(path.stem, "unsupported", reason=str(error))
    except CpdeformError as error:
        return GoldenErrors(path.stem, "failed", reason=str(error))
    except Exception as error:
        return GoldenErrors(path.stem, "failed", reason=f"It raised {type(error).__name__}: {error}".replace("\n", " "))
