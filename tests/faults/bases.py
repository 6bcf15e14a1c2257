"""Sound files of every kind that is read, for tests to damage."""

from __future__ import annotations

import importlib.metadata
import json
from pathlib import Path

import h5py
import numpy as np
from toy_fixtures import write_toy_task

from cpdeform.core.goal import write_goal
from cpdeform.core.plugins import Registry, load_registry
from cpdeform.planning.optimizer import TrajectoryOptimizer
from cpdeform.run.configuration import RunConfiguration
from cpdeform.run.deform import deform
from cpdeform.run.record import save_result

GRID_SIZE = 16
SCENE = {
    "grid_size": GRID_SIZE,
    "bodies": [{"kind": "sphere", "position": [0.4, 0.4, 0.4], "radius": 0.1, "particle_count": 60}],
    "tools": [{"kind": "Sphere", "radius": 0.05, "position": [0.4, 0.7, 0.4], "action_scale": [0.02, 0.02, 0.02]}],
}


def registry_with_toys() -> Registry:
    """The installed plugins, and the toys that the record is made with."""
    toys = importlib.metadata.EntryPoint("toy", "cpdeform_toy.plugin", "cpdeform")
    return load_registry([*importlib.metadata.entry_points(group="cpdeform"), toys])


def make_bases(directory: Path) -> Path:
    """Goals, grids, a task, a run record and a recording of PlasticineLab's form."""
    generator = np.random.default_rng(0)
    (directory / "task").mkdir(parents=True)
    limits = {"tools": {"0": {"friction": 0.5, "lower_bound": [0.0, 0.01, 0.0]}}}
    variants = {"v1": {"step_count": 4}, "v2": {"scene": {"bodies": {"0": {"radius": 0.05}}}}}
    task = write_toy_task(directory / "task", scene=SCENE, limits=limits, variants=variants, rest_steps=1)
    positions = generator.uniform(0.3, 0.6, (200, 3))
    grid = np.zeros((GRID_SIZE,) * 3)
    grid[5:9, 5:9, 5:9] = generator.uniform(0.1, 1.0, (4, 4, 4))
    write_goal(directory / "goal.npz", positions, grid=grid, corresponds=True)
    np.savez_compressed(directory / "plain.npz", position=positions)
    np.save(directory / "plain.npy", positions.astype(np.float32))
    with h5py.File(directory / "goal.h5", "w") as file:
        file.create_dataset("position", data=np.tile(positions, (4, 1)), compression="gzip", shuffle=True)
        cells = np.argwhere(grid > 0.0)
        file["grid_cells"], file["grid_mass"], file["corresponds"] = cells, grid[tuple(cells.T)], True
    np.save(directory / "dense.npy", grid)
    np.savez(directory / "dense.npz", a=grid.astype(np.float32))
    np.savez(directory / "sparse.npz", **{"a/cells": cells.astype(np.uint8), "a/count": grid[tuple(cells.T)]})
    _make_record(directory, task)
    _make_recording(directory / "recordings", cells, grid)
    return directory


def _make_record(directory: Path, task: Path) -> None:
    parts = {"simulator": "toy", "ot_solver": "toy", "placer": "toy"}
    result = deform(str(task), optimizer=TrajectoryOptimizer(iterations=2), registry=registry_with_toys(), **parts)
    configuration = RunConfiguration(task=str(task), backend="toy", ot="toy", placer="toy")
    save_result(result, directory / "record", configuration=configuration)


def _make_recording(directory: Path, cells: np.ndarray, grid: np.ndarray) -> None:
    generator = np.random.default_rng(1)
    (directory / "golden").mkdir(parents=True)
    (directory / "plasticinelab").mkdir()
    positions, zeros = generator.uniform(0.3, 0.5, (60, 3)), np.zeros((60, 3))
    np.savez(
        directory / "golden" / "torus-v2-seed0.npz",
        x0=positions, v0=zeros, F0=np.tile(np.eye(3), (60, 1, 1)), C0=np.zeros((60, 3, 3)), x=positions + 0.01, v=zeros,
        prim=np.tile([0.4, 0.7, 0.4, 1.0, 0.0, 0.0, 0.0], (4, 1)), actions=generator.uniform(-1, 1, (3, 3)),
        grad=np.full((3, 3), 1e299), total_loss=1.0, softness=666.0, n_grid=GRID_SIZE, substeps=4, dt=1e-4,
    )  # fmt: skip
    (directory / "plasticinelab" / "scenes.json").write_text(json.dumps({"torus": SCENE, "move": SCENE}))
    np.savez(
        directory / "plasticinelab" / "target_grids.npz",
        **{"Torus3D-v2/cells": cells.astype(np.uint8), "Torus3D-v2/count": grid[tuple(cells.T)].astype(np.float32)},
    )
