"""A record keeps the shape files of tools and bodies from meshes: moved, it goes on and is evaluated with nothing else."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import yaml

import cpdeform.testing
from cpdeform.core.plugins import load_registry
from cpdeform.run.deform import deform
from cpdeform.run.evaluation import evaluate_record
from cpdeform.run.record_reader import load_record
from cpdeform.run.resolve import resolve

SHAPE = Path(cpdeform.testing.__file__).with_name("ellipsoid.npz")
TOYS = {"simulator": "toy", "ot_solver": "toy", "placer": "toy"}


def test_a_record_needs_no_other_files(make_toy_task, tmp_path: Path, toy_entry_points) -> None:
    path = make_toy_task()
    shutil.copy(SHAPE, tmp_path / "shape.npz")
    content = yaml.safe_load(path.read_text())
    content["scene"]["tools"][0] = {"kind": "Mesh", "file": "shape.npz", "position": [0.4, 0.7, 0.4], "action_scale": [0.02] * 3}
    content["scene"]["bodies"].append(
        {"kind": "mesh", "file": "shape.npz", "position": [0.7, 0.3, 0.7], "scale": 0.5, "particle_count": 20}
    )
    path.write_text(yaml.safe_dump(content))
    registry = load_registry(toy_entry_points)
    result = deform(str(path), **TOYS, seed=1, stages=1, settings={"optimizer": {"iterations": 2}}, registry=registry)
    result.save(tmp_path / "run")
    same = resolve({"task": str(path)}, record=load_record(tmp_path / "run"), registry=registry)
    assert same.first_stage == 1
    assert len(list((tmp_path / "run").glob("shape-*.npz"))) == 1
    shutil.move(tmp_path / "run", tmp_path / "moved")
    for file in ("shape.npz", "goal.npz", "shift.yaml"):
        (tmp_path / file).unlink()
    record = load_record(tmp_path / "moved")
    assert {Path(shape.file).parent for shape in (record.task.scene.tools[0], record.task.scene.bodies[1])} == {tmp_path / "moved"}
    assert evaluate_record(record).particle_count == 80
    rest = deform(resume=tmp_path / "moved", stages=1, registry=registry)
    assert np.isfinite(rest.loss_final)
    rest.save(tmp_path / "rest")
    assert load_record(tmp_path / "rest").task.scene.tools[0].shape().volume > 0.0
