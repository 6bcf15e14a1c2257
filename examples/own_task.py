"""A task of your own: clay and a tool described in Python, and a goal from points or from a mesh.

Run it with ``python examples/own_task.py`` for a block that becomes a wedge, or with ``--mesh vase.stl`` for a mesh of yours.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from cpdeform import RunResult, Scene, Task, deform
from cpdeform.core.sampling import sample_particles

BLOCK = {"kind": "box", "position": (0.5, 0.1, 0.5), "widths": (0.2, 0.1, 0.16)}
HAND = {
    "kind": "Box",
    "half_extents": (0.05, 0.015, 0.09),
    "position": (0.5, 0.25, 0.5),
    "action_scale": (0.01, 0.01, 0.01, 0.02, 0.02, 0.02),
}


def make_scene(particles: int) -> Scene:
    """A block of clay and a flat hand that moves and turns."""
    return Scene.model_validate({"bodies": [{**BLOCK, "particle_count": particles}], "tools": [HAND], "ground_friction": 2.0})


def wedge(scene: Scene) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """The block's particles, pressed down more and more towards its right end."""
    points = sample_particles(scene)
    floor, left = points[:, 1].min(), points[:, 0].min()
    share = (points[:, 0] - left) / np.ptp(points[:, 0])
    points[:, 1] = floor + (points[:, 1] - floor) * (1.0 - 0.4 * share)
    return points


def plan(scene: Scene, *, mesh: Path | None, folder: Path, stages: int, iterations: int) -> RunResult:
    """Make the task, with its goal file in `folder`, and plan for it."""
    folder.mkdir(parents=True, exist_ok=True)
    schedule = {"step_count": 10, "rest_steps": 5, "stage_count": stages}
    if mesh is not None:
        task = Task.from_mesh(mesh, scene=scene, path=folder / "goal.npz", **schedule)
    else:
        task = Task.from_points(wedge(scene), scene=scene, path=folder / "goal.npz", name="wedge", **schedule)
    return deform(task, seed=0, settings={"optimizer": {"iterations": iterations}})


def main(arguments: Sequence[str] | None = None) -> None:
    """Plan, and write the record."""
    parser = argparse.ArgumentParser(description="Plan for a task of your own.")
    parser.add_argument("--mesh", type=Path, default=None, help="STL, OBJ, PLY or GLB; defaults to a wedge made of points")
    parser.add_argument("--out", type=Path, default=Path("runs/own-task"))
    parser.add_argument("--particles", type=int, default=5000)
    parser.add_argument("--stages", type=int, default=3)
    parser.add_argument("--iterations", type=int, default=20)
    options = parser.parse_args(arguments)
    scene = make_scene(options.particles)
    result = plan(scene, mesh=options.mesh, folder=options.out / "task", stages=options.stages, iterations=options.iterations)
    result.save(options.out / "run", overwrite=True)
    print(f"{result.status.value}: W1 to the goal {result.metric_initial:.4f} -> {result.metric_value:.4f} domain edges")


if __name__ == "__main__":
    main()
