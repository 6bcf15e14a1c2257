"""Scenes, states and actions that the tests of the backends share, and the backends themselves."""

from __future__ import annotations

import contextlib
import dataclasses
import importlib
import importlib.util
import math
from typing import Any

import pytest
import torch
from torch import Tensor

from cpdeform.core.scene import Scene
from cpdeform.core.simulator import Simulator
from cpdeform.core.state import State

BACKENDS = {
    "warp": ("cpdeform.backends.warp.simulator", "SimulatorWarp"),
    "taichi": ("cpdeform.backends.taichi.simulator", "SimulatorTaichi"),
    "native": ("cpdeform_native.simulator", "SimulatorNative"),
}
ORACLE = ("cpdeform_example.simulator", "SimulatorExample")
MOST_THREADS = 3
"""Threads that the tests work with; a process's Taichi has a fixed number."""

ALL_MOTIONS = (0.02, 0.02, 0.02, 0.3, 0.3, 0.3)
TILTED = (0.8, 0.36, 0.36, math.sqrt(1.0 - 0.64 - 2 * 0.36**2))
TOOLS: dict[str, dict[str, Any]] = {
    "Sphere": {"radius": 0.03, "position": (0.5, 0.135, 0.5), "action_scale": (0.02, 0.02, 0.02)},
    "Capsule": {"radius": 0.03, "height": 0.06, "position": (0.47, 0.15, 0.5)},
    "Box": {"half_extents": (0.03, 0.02, 0.04), "rounding": 0.01, "position": (0.5, 0.13, 0.47)},
    "Cylinder": {"radius": 0.03, "half_height": 0.03, "position": (0.52, 0.13, 0.52)},
    "Torus": {"major_radius": 0.04, "tube_radius": 0.02, "position": (0.503, 0.123, 0.498)},
}

STEPS = {"position": 1e-8, "velocity": 1e-6, "affine": 1e-5, "elastic_strain": 1e-8, "tool_pose": 1e-8}
"""Step of the finite differences for each tensor of the state."""


def simulator_class(module: str, name: str) -> type[Simulator]:
    """A simulator's class; skips the test where its package is not installed."""
    package = {"cpdeform.backends.warp.simulator": "warp", "cpdeform.backends.taichi.simulator": "taichi"}.get(module, module)
    if importlib.util.find_spec(package.partition(".")[0]) is None:
        pytest.skip(f"{name} needs the package {package.partition('.')[0]}, which is not installed")
    found: type[Simulator] = getattr(importlib.import_module(module), name)
    return found


def backend_class(name: str) -> type[Simulator]:
    """A backend's class; Taichi's runtime is started with as many threads as any test works with, if it does not run yet."""
    found = simulator_class(*BACKENDS[name])
    if name == "taichi":
        from cpdeform.backends.taichi.runtime import TaichiRuntimeError, require

        with contextlib.suppress(TaichiRuntimeError):
            require(torch.device("cpu"), MOST_THREADS)
    return found


def tool(kind: str, **changes: Any) -> dict[str, Any]:
    return {"kind": kind, "action_scale": ALL_MOTIONS, "rotation_wxyz": TILTED, **TOOLS[kind], **changes}


def scene(*tools: dict[str, Any], **changes: Any) -> Scene:
    body = {"kind": "box", "position": (0.5, 0.06, 0.5), "widths": (0.12, 0.1, 0.12), "particle_count": 300}
    return Scene.model_validate({"bodies": [body], "tools": tools, "grid_size": 32, "substeps": 5, **changes})


def floating(**changes: Any) -> Scene:
    """A block in the middle of the domain, away from walls, without gravity."""
    body = {"kind": "box", "position": (0.5, 0.5, 0.5), "widths": (0.2, 0.15, 0.1), "particle_count": 400}
    return scene(**{"bodies": [body], "gravity_parameter": (0.0, 0.0, 0.0), **changes})


def stirred(simulator: Simulator, *, batch_size: int = 1, seed: int = 0) -> State:
    """A start with random velocities and strains on both sides of the yield surface."""
    generator = torch.Generator().manual_seed(seed)
    state = simulator.initial_state(batch_size=batch_size)

    def noise(tensor: Tensor, size: float) -> Tensor:
        return size * torch.randn(tensor.shape, generator=generator, dtype=torch.float64).to(tensor)

    return dataclasses.replace(
        state,
        velocity=noise(state.velocity, 0.5),
        affine=noise(state.affine, 20.0),
        elastic_strain=noise(state.elastic_strain, 0.02),
    )


def actions_for(simulator: Simulator, *, batch_size: int = 1, steps: int = 2, seed: int = 1) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    shape = (batch_size, steps, simulator.scene.action_size)
    return (0.5 * torch.randn(shape, generator=generator, dtype=torch.float64)).clamp(-1, 1).to(simulator.dtype)


TOOLS["RollingPin"] = {"radius": 0.03, "height": 0.08, "position": (0.5, 0.135, 0.5), "action_scale": (0.5, 0.3, 0.02)}
TOOLS["Chopsticks"] = {
    "radius": 0.02,
    "height": 0.06,
    "gap": 0.066,
    "position": (0.51, 0.16, 0.5),
    "action_scale": (*ALL_MOTIONS, 0.01),
    "rotation_wxyz": (0.98, 0.1, 0.1, math.sqrt(1.0 - 0.98**2 - 0.02)),
}
CASES = {
    "rolling pin": scene(tool("RollingPin")),
    "chopsticks": scene(tool("Chopsticks")),
    "closing chopsticks": scene(tool("Chopsticks", gap=0.0605)),
    "sphere": scene(tool("Sphere")),
    "sphere, hard boundary": scene(tool("Sphere"), softness=0.0),
    "capsule, sticky floor": scene(tool("Capsule"), ground_friction=100.0),
    "box, slippery floor": scene(tool("Box"), ground_friction=0.0),
    "cylinder": scene(tool("Cylinder")),
    "torus": scene(tool("Torus")),
    "two tools": scene(tool("Capsule"), tool("Box")),
    "fixed tool": scene(tool("Capsule"), tool("Sphere", action_scale=())),
    "stiff": scene(tool("Sphere"), material={"youngs_modulus": 20000.0, "poisson_ratio": 0.3, "yield_stress": 1e6}),
    "tool at its bound": scene(tool("Sphere", lower_bound=(0.1, 0.134, 0.1))),
}


def positions_and_gradient(backend: str, case: str, device: str, **options: Any) -> tuple[Tensor, Tensor]:
    """Positions of a rollout of two stirred worlds, and the gradient of their sum with respect to the actions, on the CPU."""
    factory = simulator_class(*BACKENDS[backend])
    simulator = factory(CASES[case], **{"dtype": torch.float64, "batch_size": 2, "device": device, **options})
    trajectory = simulator.rollout(stirred(simulator, batch_size=2), actions_for(simulator, batch_size=2).to(device))
    gradient = simulator.vjp(trajectory, torch.ones_like(trajectory.positions)).actions
    return trajectory.positions.cpu(), gradient.cpu()
