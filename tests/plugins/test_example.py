"""The example plugin: found through its entry point, and equal to the Warp backend in values and gradients."""

from __future__ import annotations

import dataclasses
import functools
import importlib
import importlib.metadata
import math
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from cpdeform.backends.warp.simulator import SimulatorWarp
from cpdeform.core.plugins import load_registry
from cpdeform.core.scene import Scene
from cpdeform.core.simulator import RolloutGradient, Simulator, Trajectory, differentiable_rollout
from cpdeform.core.state import State

FOLDER = Path(__file__).parents[2] / "plugins" / "cpdeform-example"
sys.path.insert(0, str(FOLDER))
SimulatorExample: type[Simulator] = importlib.import_module("cpdeform_example.simulator").SimulatorExample

TILTED = (0.8, 0.36, 0.36, math.sqrt(1.0 - 0.64 - 2 * 0.36**2))
LYING = (math.sqrt(0.5), math.sqrt(0.5), 0.0, 0.0)
FIELDS = ("position", "velocity", "affine", "elastic_strain", "tool_pose")
TOOLS: dict[str, dict[str, Any]] = {
    "Sphere": {"radius": 0.04, "position": (0.5, 0.14, 0.5)},
    "Capsule": {"radius": 0.03, "height": 0.06, "position": (0.47, 0.14, 0.5)},
    "Box": {"half_extents": (0.04, 0.03, 0.05), "rounding": 0.01, "position": (0.5, 0.13, 0.47)},
    "Cylinder": {"radius": 0.04, "half_height": 0.03, "position": (0.52, 0.13, 0.52)},
    "Torus": {"major_radius": 0.04, "tube_radius": 0.025, "position": (0.503, 0.123, 0.498)},
    "RollingPin": {
        "radius": 0.04,
        "height": 0.08,
        "position": (0.5, 0.14, 0.5),
        "rotation_wxyz": LYING,
        "action_scale": (0.3, 0.07, 0.005),
    },
    "Chopsticks": {
        "radius": 0.03,
        "height": 0.1,
        "gap": 0.08,
        "position": (0.5, 0.2, 0.5),
        "action_scale": (0.02, 0.02, 0.02, 0.04, 0.04, 0.04, 0.02),
    },
}


def tool(kind: str, **changes: Any) -> dict[str, Any]:
    return {"kind": kind, "rotation_wxyz": TILTED, "action_scale": (0.02,) * 3 + (0.3,) * 3, **TOOLS[kind], **changes}


def scene(*tools: dict[str, Any], **changes: Any) -> Scene:
    body = {"kind": "box", "position": (0.5, 0.07, 0.5), "widths": (0.12, 0.1, 0.12), "particle_count": 100}
    return Scene.model_validate({"bodies": [body], "tools": tools, "grid_size": 32, "substeps": 4, **changes})


SOFT_BALL = {
    "kind": "sphere",
    "position": (0.56, 0.08, 0.5),
    "radius": 0.05,
    "particle_count": 40,
    "material": {"youngs_modulus": 500.0, "poisson_ratio": 0.4, "yield_stress": 2.0},
}
BLOCK = {"kind": "box", "position": (0.46, 0.07, 0.5), "widths": (0.1, 0.1, 0.1), "particle_count": 60}

CASES: dict[str, Scene] = {
    **{kind: scene(tool(kind)) for kind in TOOLS},
    "no tool": scene(),
    "hard boundary": scene(tool("Sphere"), softness=0.0),
    "slippery floor": scene(tool("Box"), ground_friction=0.0),
    "sticky floor": scene(tool("Capsule"), ground_friction=100.0),
    "raised floor": scene(tool("Sphere"), ground_height=0.02),
    "two bodies, own materials": scene(tool("Sphere"), bodies=[BLOCK, SOFT_BALL]),
    "three tools, one fixed": scene(tool("Capsule"), tool("Sphere", action_scale=()), tool("Box")),
    "translation only": scene(tool("Capsule", action_scale=(0.02,) * 3)),
    "tool at its bound": scene(tool("Sphere", lower_bound=(0.1, 0.139, 0.1))),
    "closing chopsticks": scene(tool("Chopsticks", gap=0.0605)),
    "against a wall": scene(bodies=[{**BLOCK, "position": (0.06, 0.06, 0.85)}], gravity_parameter=(-40.0, -20.0, 40.0)),
    "coarse grid": scene(tool("Torus"), grid_size=16),
    "node distance not a power of two": scene(tool("Cylinder"), grid_size=24),
}


def start_of(simulator: Simulator, seed: int) -> State:
    """A start with random velocities and strains on both sides of the yield surface."""
    generator = torch.Generator().manual_seed(seed)
    state = simulator.initial_state()
    sizes = {"velocity": 0.5, "affine": 20.0, "elastic_strain": 0.02}
    return dataclasses.replace(state, **{name: size * noise(getattr(state, name), generator) for name, size in sizes.items()})


def noise(like: Tensor, generator: torch.Generator) -> Tensor:
    return torch.randn(like.shape, generator=generator, dtype=torch.float64)


def outcome(
    kind: type[Simulator], scene: Scene, *, batch_size: int, seed: int, rest: bool = False
) -> tuple[Trajectory, RolloutGradient]:
    """A rollout of two steps and the gradient of a random linear function of everything that it returns."""
    simulator = kind(scene, batch_size=batch_size, dtype=torch.float64)
    generator = torch.Generator().manual_seed(seed + 1)
    start = simulator.initial_state() if rest else start_of(simulator, seed)
    actions = torch.empty(batch_size, 2, scene.action_size, dtype=torch.float64).uniform_(-1.0, 1.0, generator=generator)
    trajectory = simulator.rollout(start, actions)
    grads = noise(trajectory.positions, generator), noise(trajectory.tool_poses, generator)
    return trajectory, simulator.vjp(trajectory, *grads)


def compare(scene: Scene, *, batch_size: int = 2, seed: int = 0, rest: bool = False) -> None:
    run = functools.partial(outcome, scene=scene, batch_size=batch_size, seed=seed, rest=rest)
    (expected, slope), (found, own) = run(SimulatorWarp), run(SimulatorExample)
    assert float((expected.positions - found.positions).abs().max()) < 1e-12
    bounds = {"position": 1e-12, "velocity": 1e-9, "affine": 1e-7, "elastic_strain": 1e-10, "tool_pose": 1e-12}
    for name, bound in bounds.items():
        error = getattr(expected.final_state, name) - getattr(found.final_state, name)
        assert float(error.abs().sum()) == 0.0 or float(error.abs().max()) < bound, name
    assert_parallel(slope.actions, own.actions, "actions")
    for name in FIELDS:
        assert_parallel(getattr(slope.initial_state, name), getattr(own.initial_state, name), name)


def assert_parallel(expected: Tensor, found: Tensor, name: str) -> None:
    """Equal to 4e-4 of the length, so that the cosine is above 0.9999999.

    All but the tools' gradients are equal to 1e-11. There the Warp backend takes the derivative of a normal without the 1e-8 that
    smooths lengths, which matters near the axis of a torus or a cylinder; here autograd has it.
    """
    assert torch.isfinite(found).all(), name
    assert float((expected - found).norm()) <= 4e-4 * float(expected.norm()) + 1e-12, name


@pytest.mark.parametrize("name", CASES)
def test_equals_the_warp_backend(name: str) -> None:
    compare(CASES[name])


@pytest.mark.parametrize("kind", TOOLS)
def test_equals_the_warp_backend_from_rest(kind: str) -> None:
    compare(scene(tool(kind)), batch_size=1, rest=True)


@st.composite
def scenes(draw: st.DrawFn) -> Scene:
    def number(low: float, high: float) -> float:
        return draw(st.floats(low, high))

    def placed(kind: str) -> dict[str, Any]:
        x, y, z = TOOLS[kind]["position"]
        rotation = torch.tensor([1.0, number(-1.0, 1.0), number(-1.0, 1.0), number(-1.0, 1.0)], dtype=torch.float64)
        return tool(
            kind,
            position=(x + number(-0.03, 0.03), y + number(-0.01, 0.03), z + number(-0.03, 0.03)),
            rotation_wxyz=tuple((rotation / rotation.norm()).tolist()),
            friction=number(0.0, 2.0),
        )

    kinds = draw(st.lists(st.sampled_from(list(TOOLS)), min_size=1, max_size=2))
    return scene(
        *(placed(kind) for kind in kinds),
        bodies=[BLOCK, SOFT_BALL] if draw(st.booleans()) else [BLOCK],
        ground_friction=draw(st.sampled_from([0.0, 0.3, 1.5, 20.0])),
        ground_height=draw(st.sampled_from([0.0, 0.015])),
        softness=draw(st.sampled_from([0.0, 200.0, 666.0])),
        gravity_parameter=(number(-2.0, 2.0), number(-2.0, 0.0), number(-2.0, 2.0)),
        grid_size=draw(st.sampled_from([16, 24, 32])),
        substeps=draw(st.integers(1, 4)),
        sampling_seed=draw(st.integers(0, 1000)),
    )


@settings(max_examples=10)
@given(scene=scenes(), seed=st.integers(0, 1000))
def test_equals_the_warp_backend_on_random_scenes(scene: Scene, seed: int) -> None:
    compare(scene, batch_size=1, seed=seed)


def test_composes_with_autograd() -> None:
    simulator = SimulatorExample(CASES["Sphere"])
    actions = torch.zeros(1, 2, simulator.scene.action_size, dtype=torch.float64, requires_grad=True)
    differentiable_rollout(simulator, simulator.initial_state(), actions).positions[:, -1].square().sum().backward()
    trajectory = simulator.rollout(simulator.initial_state(), actions)
    slope = torch.zeros_like(trajectory.positions)
    slope[:, -1] = 2.0 * trajectory.positions[:, -1]
    expected = simulator.vjp(trajectory, slope).actions
    assert expected.abs().min() > 0.0
    assert actions.grad is not None
    assert torch.allclose(actions.grad, expected, rtol=1e-9, atol=0.0)


def test_entry_point_registers_the_simulator() -> None:
    project = tomllib.loads((FOLDER / "pyproject.toml").read_text())["project"]
    points = [
        importlib.metadata.EntryPoint(name=name, value=value, group="cpdeform")
        for name, value in project["entry-points"]["cpdeform"].items()
    ]
    registry = load_registry(points)
    assert not registry.failures
    assert registry.names("simulator") == ["example"]
    assert registry.load("simulator", "example") is SimulatorExample
