"""Record golden files with the float64 oracle: `python -m cpdeform.testing.record_oracle DIR`.

The oracle is the simulator `example`, plain PyTorch whose gradients nobody wrote by hand. The recordings let any machine hold every
simulator against it, forward and backward, without PlasticineLab's files.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any

import numpy as np
import torch
import typer
from numpy.typing import NDArray
from torch import Tensor

from cpdeform.core.plugins import load_registry
from cpdeform.core.scene import Scene
from cpdeform.core.state import initial_state
from cpdeform.planning.objectives.plasticinelab import ObjectivePlasticineLab, mass_grid
from cpdeform.testing.golden_file import recorded_start
from cpdeform.testing.simulator_bench import SimulatorFactory

GOAL_OFFSET = (0.04, -0.01, 0.03)
"""The goal that the recorded loss belongs to is the start, moved by this, length units."""


@dataclasses.dataclass(frozen=True)
class Recording:
    """What is recorded.

    Attributes:
        scene: Fields of the `Scene`.
        steps: Environment steps T.
        seed: Of the actions and the start.
        speed: Size of random start velocities, length units/second.
        affine: Size of the random affine velocity field at the start, 1/second.
        strain: Size of the random deformation at the start, dimensionless.
    """

    scene: Mapping[str, Any]
    steps: int
    seed: int
    speed: float = 0.0
    affine: float = 0.0
    strain: float = 0.0


_COMMON = {"grid_size": 32, "substeps": 8}
_SIX = (0.02, 0.02, 0.02, 0.3, 0.3, 0.3)
RECORDINGS: Mapping[str, Recording] = MappingProxyType(
    {
        # Soft and stiff clay at rest under tools that press, turn and stand in the way, on a raised floor that brakes.
        "press": Recording(
            scene={
                **_COMMON,
                "bodies": [
                    {"kind": "box", "position": (0.46, 0.1, 0.5), "widths": (0.16, 0.1, 0.16), "particle_count": 140},
                    {
                        "kind": "sphere",
                        "position": (0.6, 0.11, 0.5),
                        "radius": 0.055,
                        "particle_count": 60,
                        "material": {"youngs_modulus": 3000.0, "poisson_ratio": 0.3, "yield_stress": 15.0},
                    },
                ],
                "tools": [
                    {
                        "kind": "Capsule",
                        "position": (0.45, 0.18, 0.52),
                        "rotation_wxyz": (0.8, 0.36, 0.0, 0.48),
                        "radius": 0.03,
                        "height": 0.08,
                        "action_scale": _SIX,
                    },
                    {
                        "kind": "Box",
                        "position": (0.41, 0.16, 0.45),
                        "rotation_wxyz": (0.96, 0.0, 0.28, 0.0),
                        "half_extents": (0.03, 0.02, 0.02),
                        "rounding": 0.01,
                        "action_scale": _SIX,
                        "friction": 0.3,
                    },
                    {
                        "kind": "Cylinder",
                        "position": (0.64, 0.16, 0.5),
                        "radius": 0.03,
                        "half_height": 0.02,
                        "action_scale": _SIX[:3],
                    },
                    {"kind": "Sphere", "position": (0.53, 0.11, 0.57), "radius": 0.03},
                ],
                "ground_height": 0.05,
                "ground_friction": 0.6,
            },
            steps=4,
            seed=0,
        ),
        # Clay in motion, strained on both sides of the yield surface, between the tools with motions of their own, hard ones.
        "knead": Recording(
            scene={
                **_COMMON,
                "bodies": [{"kind": "box", "position": (0.5, 0.07, 0.5), "widths": (0.2, 0.12, 0.14), "particle_count": 180}],
                "tools": [
                    {
                        "kind": "RollingPin",
                        "position": (0.43, 0.15, 0.5),
                        "rotation_wxyz": (0.6, 0.8, 0.0, 0.0),
                        "radius": 0.03,
                        "height": 0.1,
                        "action_scale": (0.5, 0.3, 0.02),
                    },
                    {
                        "kind": "Chopsticks",
                        "position": (0.56, 0.17, 0.5),
                        "radius": 0.02,
                        "height": 0.08,
                        "gap": 0.08,
                        "action_scale": (*_SIX, 0.03),
                    },
                    {
                        "kind": "Torus",
                        "position": (0.5, 0.14, 0.56),
                        "rotation_wxyz": (0.96, 0.0, 0.0, 0.28),
                        "major_radius": 0.04,
                        "tube_radius": 0.02,
                        "action_scale": _SIX,
                    },
                ],
                "softness": 0.0,
                "ground_friction": 20.0,
            },
            steps=3,
            seed=1,
            speed=0.4,
            affine=10.0,
            strain=0.015,
        ),
    }
)


def record(recording: Recording, factory: SimulatorFactory) -> dict[str, NDArray[Any]]:
    """Run a rollout and its gradient.

    Args:
        recording: What to run.
        factory: Makes the simulator, see `SimulatorFactory`; it has to compute in float64.

    Returns:
        The arrays of a golden file, see `cpdeform.testing.golden_file`.
    """
    scene = Scene.model_validate(recording.scene)
    generator = np.random.default_rng(recording.seed)
    start = initial_state(scene, dtype=torch.float64)
    count = scene.particle_count
    arrays: dict[str, NDArray[Any]] = {
        "x0": start.position[0].numpy(),
        "v0": recording.speed * generator.standard_normal((count, 3)),
        "C0": recording.affine * generator.standard_normal((count, 3, 3)),
        "F0": np.eye(3) + recording.strain * generator.standard_normal((count, 3, 3)),
        "actions": generator.uniform(-1.0, 1.0, (recording.steps, scene.action_size)),
        "prim": _numbers(scene, start.tool_pose),
    }
    simulator = factory(scene, batch_size=1, device="cpu", dtype=torch.float64)
    actions = torch.as_tensor(arrays["actions"]).unsqueeze(0)
    trajectory = simulator.rollout(recorded_start(scene, arrays), actions)
    grid = mass_grid(start.position[0] + torch.tensor(GOAL_OFFSET, dtype=torch.float64), scene)
    result = ObjectivePlasticineLab(scene, grid).evaluate(trajectory)
    gradient = simulator.vjp(trajectory, result.grad_positions, result.grad_tools)
    return {
        **arrays,
        "prim": _numbers(scene, trajectory.tool_poses[0]),
        "x": trajectory.final_state.position[0].numpy(),
        "v": trajectory.final_state.velocity[0].numpy(),
        "grad": gradient.actions[0].numpy(),
        "total_loss": result.loss[0].numpy(),
        "goal_grid": grid.numpy(),
        "scene": np.array(scene.model_dump_json()),
    }


def _numbers(scene: Scene, poses: Tensor) -> NDArray[np.float64]:
    """Tool poses (T, M, 8) as golden files hold them: 7 numbers a tool, 8 for one with a gap."""
    parts = [poses[:, index, : 8 if hasattr(tool, "gap") else 7] for index, tool in enumerate(scene.tools)]
    return np.asarray(torch.cat(parts, dim=1).numpy())


def main(
    directory: Annotated[Path, typer.Argument(help="Folder that the files are written to.")],
    backend: Annotated[str, typer.Option(help="Simulator to record; must compute in float64.")] = "example",
) -> None:
    """Record the golden files of this project."""
    factory = load_registry().load("simulator", backend)
    directory.mkdir(parents=True, exist_ok=True)
    for name, recording in RECORDINGS.items():
        start, path = time.perf_counter(), directory / f"{name}.npz"
        arrays: dict[str, Any] = dict(record(recording, factory))
        np.savez_compressed(path, **arrays)
        typer.echo(f"{path.name}: {path.stat().st_size} bytes, {time.perf_counter() - start:.1f} s")


if __name__ == "__main__":
    typer.run(main)
