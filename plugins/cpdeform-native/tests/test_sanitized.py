"""Short computations through all of the extension's kernels; their sense is `make sanitize`, which watches every access."""

from __future__ import annotations

import pytest
import torch

from cpdeform.core.scene import Scene
from cpdeform_native import _simulator, _transport
from cpdeform_native.ot import OTSolverNative
from cpdeform_native.simulator import SimulatorNative

TOOLS = (
    {"kind": "Sphere", "radius": 0.05},
    {"kind": "Capsule", "radius": 0.03, "height": 0.1},
    {"kind": "Box", "half_extents": (0.05, 0.04, 0.03), "rounding": 0.01},
    {"kind": "Cylinder", "radius": 0.05, "half_height": 0.03},
    {"kind": "Torus", "major_radius": 0.05, "tube_radius": 0.02},
    {"kind": "RollingPin", "radius": 0.03, "height": 0.1},
    {"kind": "Chopsticks", "radius": 0.02, "height": 0.1},
)
ACTION_COUNTS = {"RollingPin": 3, "Chopsticks": 7}


def scene_with_every_tool() -> Scene:
    """A block from the floor up to the walls' corner, with a tool of each kind in it."""
    body = {"kind": "box", "position": (0.2, 0.1, 0.2), "widths": (0.4, 0.2, 0.4), "particle_count": 333}
    tools = []
    for number, tool in enumerate(TOOLS):
        count = ACTION_COUNTS.get(str(tool["kind"]), 6)
        tools.append({**tool, "position": (0.05 + 0.05 * number, 0.1, 0.2), "action_scale": (0.02,) * count})
    material = {"youngs_modulus": 5.0, "poisson_ratio": 0.3, "yield_stress": 0.1}
    return Scene.model_validate({"bodies": [body], "tools": tools, "material": material, "grid_size": 24, "substeps": 4})


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("instruction_set", _simulator.instruction_sets())
@pytest.mark.parametrize("memory_budget", [1 << 29, 0])
def test_every_tool_at_the_walls(instruction_set: str, dtype: torch.dtype, memory_budget: int) -> None:
    scene = scene_with_every_tool()
    simulator = SimulatorNative(
        scene, batch_size=3, dtype=dtype, threads=2, instruction_set=instruction_set, memory_budget=memory_budget
    )
    state = simulator.initial_state(batch_size=3)
    actions = torch.linspace(-1.0, 1.0, 3 * 3 * scene.action_size, dtype=dtype).reshape(3, 3, -1)
    trajectory = simulator.rollout(state, actions)
    gradient = simulator.vjp(trajectory, torch.ones_like(trajectory.positions), torch.ones_like(trajectory.tool_poses))
    assert bool(trajectory.positions.isfinite().all())
    assert bool(gradient.actions.isfinite().all())
    assert float(gradient.actions.abs().max()) > 0.0


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("instruction_set", _transport.instruction_sets())
@pytest.mark.parametrize("exponent", [1, 2])
def test_transport_cold_and_warm(instruction_set: str, dtype: torch.dtype, exponent: int) -> None:
    generator = torch.Generator().manual_seed(0)
    source, target = (torch.rand(count, 3, generator=generator, dtype=dtype) for count in (333, 2100))
    solver = OTSolverNative(blur=0.05, exponent=exponent, threads=2, instruction_set=instruction_set)
    cold = solver.solve(source, target)
    warm = solver.solve(source + 1e-4, target, previous=cold)
    assert float(warm.value) == pytest.approx(float(cold.value), abs=1e-3)
