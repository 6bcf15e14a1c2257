"""Every installed simulator against recordings of the plain PyTorch simulator, which are part of the project."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from backend_cases import BACKENDS, backend_class

from cpdeform.core.errors import MissingExtraError
from cpdeform.core.plugins import load_registry
from cpdeform.core.scene import Scene
from cpdeform.core.shapes.kinds import TOOLS
from cpdeform.core.simulator import Simulator
from cpdeform.testing import GoldenErrors, check_golden_file, compare_golden, read_golden
from cpdeform.testing.golden_file import golden_files
from cpdeform.testing.record_oracle import RECORDINGS, record

DATA = Path(__file__).parents[1] / "data"
NAMES = list(RECORDINGS)
SIMULATORS = load_registry().names("simulator")

DOUBLE = {"position_error": 1e-10, "velocity_error": 1e-9, "pose_error": 1e-10, "gradient_norm_error": 1e-5, "loss_error": 1e-10}
SINGLE = {"position_error": 5e-6, "velocity_error": 2e-4, "pose_error": 5e-6, "gradient_norm_error": 1e-4, "loss_error": 1e-5}
COSINE = {torch.float64: 1e-8, torch.float32: 1e-6}
LARGEST_FILE = 100_000


def path(name: str) -> Path:
    return DATA / f"{name}.npz"


def simulator_named(name: str) -> type[Simulator]:
    """A simulator's class; skips the test where a package that it needs is not installed."""
    if name in BACKENDS:
        return backend_class(name)
    try:
        found: type[Simulator] = load_registry().load("simulator", name)
    except MissingExtraError as error:
        pytest.skip(str(error))
    return found


def out_of_bounds(errors: GoldenErrors, dtype: torch.dtype) -> list[str]:
    """What is farther from the recording than rounding explains; nothing may be missing."""
    bounds = DOUBLE if dtype is torch.float64 else SINGLE
    wrong = [name for name, bound in bounds.items() if getattr(errors, name) is None or not getattr(errors, name) < bound]
    cosine = errors.gradient_cosine
    return wrong if cosine is not None and 1.0 - cosine < COSINE[dtype] else [*wrong, "gradient_cosine"]


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=["float64", "float32"])
@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("simulator", SIMULATORS)
def test_end_and_gradient_are_the_oracles(simulator: str, name: str, dtype: torch.dtype) -> None:
    factory = simulator_named(simulator)
    if dtype not in factory.capabilities.dtypes:
        pytest.skip(f"{simulator} does not compute in {dtype}")
    errors = check_golden_file(path(name), factory, dtype=dtype)
    assert errors.status == "passed", str(errors)
    assert out_of_bounds(errors, dtype) == [], str(errors)


def test_the_files_are_those_of_the_recorder_and_small() -> None:
    assert {file.stem for file in golden_files(DATA)} == set(NAMES)
    assert all(file.stat().st_size < LARGEST_FILE for file in golden_files(DATA))
    for name in NAMES:
        assert read_golden(path(name)).scene == Scene.model_validate(RECORDINGS[name].scene)


def test_all_kinds_of_tools_and_motions_are_recorded() -> None:
    tools = [tool for name in NAMES for tool in read_golden(path(name)).scene.tools]
    # Shape files are no part of a recording.
    assert {tool.kind for tool in tools} == set(TOOLS) - {"Mesh"}
    assert {tool.action_size for tool in tools} == {0, 3, 6, 7}
    for name in NAMES:
        assert read_golden(path(name)).arrays["grad"].all()


@pytest.mark.parametrize("name", NAMES)
def test_every_tool_leaves_its_mark(name: str) -> None:
    golden = read_golden(path(name))
    simulator = backend_class("warp")(golden.scene, dtype=torch.float64)
    for index in range(len(golden.scene.tools)):
        pose = golden.state.tool_pose.clone()
        pose[:, index, 1] += 0.4
        end = simulator.rollout(golden.state.with_tools(pose), golden.actions).positions[0, -1].numpy()
        assert np.abs(end - golden.arrays["x"]).max() > 1e-4


@pytest.mark.parametrize(
    "change",
    [
        {"gravity_scale": 30.001},
        {"softness": 600.0},
        {"ground_friction": 0.61},
        {"ground_height": 0.0},
        {"time_step": 1.0001e-4},
        {"yield_stress": 50.01},
        {"poisson_ratio": 0.2001},
        {"friction": 0.31},
    ],
    ids=lambda change: next(iter(change)),
)
def test_a_simulator_with_another_physics_is_caught(change: dict[str, float]) -> None:
    warp: Any = backend_class("warp")

    def factory(scene: Scene, **options: Any) -> Simulator:
        content = scene.model_dump()
        name = next(iter(change))
        holder = {"friction": content["tools"][1], "yield_stress": content["material"], "poisson_ratio": content["material"]}
        holder.get(name, content).update(change)
        return warp(Scene.model_validate(content), **options)

    errors = compare_golden(read_golden(path("press")), factory, dtype=torch.float64)
    assert {"position_error", "velocity_error"} & set(out_of_bounds(errors, torch.float64)), str(errors)


def test_a_wrong_gradient_is_caught() -> None:
    warp: Any = backend_class("warp")

    def vjp(self: Simulator, *gradients: Any) -> Any:
        found = warp.vjp(self, *gradients)
        # The last component of all actions, the closing of a box's turn, is lost.
        return dataclasses.replace(found, actions=torch.cat([found.actions[..., :-1], 0.0 * found.actions[..., -1:]], dim=-1))

    broken = type("SimulatorBroken", (warp,), {"vjp": vjp})
    errors = compare_golden(read_golden(path("press")), broken, dtype=torch.float64)
    assert set(out_of_bounds(errors, torch.float64)) == {"gradient_norm_error", "gradient_cosine"}


def test_recording_a_simulator_gives_what_it_is_held_against() -> None:
    """Warp, recorded, is equal to the file in everything that is not computed, and close in the rest."""
    found, golden = record(RECORDINGS["press"], backend_class("warp")), read_golden(path("press"))
    assert json.loads(str(found["scene"])) == json.loads(golden.scene.model_dump_json())
    for name in ("x0", "v0", "C0", "F0", "actions", "goal_grid"):
        np.testing.assert_allclose(found[name], golden.arrays[name], rtol=0.0, atol=1e-15)
    for name in ("x", "prim", "grad", "total_loss"):
        np.testing.assert_allclose(found[name], golden.arrays[name], rtol=1e-4, atol=1e-9)


def changed_file(folder: Path, change: Any) -> Path:
    with np.load(path("press")) as file:
        arrays = dict(file)
    change(arrays)
    np.savez(folder / "changed.npz", **arrays)
    return folder / "changed.npz"


def test_files_that_cannot_be_used_say_why(tmp_path: Path) -> None:
    def with_a_spoon(arrays: dict[str, Any]) -> None:
        arrays["scene"] = np.array(str(arrays["scene"]).replace('"Capsule"', '"Spoon"'))

    def without_cells(arrays: dict[str, Any]) -> None:
        arrays["scene"] = np.array(str(arrays["scene"]).replace('"grid_size":32', '"grid_size":4'))

    warp = backend_class("warp")
    errors = check_golden_file(changed_file(tmp_path, with_a_spoon), warp)
    assert (errors.status, "Spoon" in errors.reason) == ("unsupported", True)
    errors = check_golden_file(changed_file(tmp_path, without_cells), warp)
    assert (errors.status, "grid_size" in errors.reason) == ("failed", True)
    errors = check_golden_file(changed_file(tmp_path, lambda arrays: arrays.pop("x0")), warp)
    assert (errors.status, 'no array "x0"' in errors.reason) == ("failed", True)
