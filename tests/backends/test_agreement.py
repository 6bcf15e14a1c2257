"""The backends against each other and against the plain PyTorch simulator, which differentiates by autograd, on random scenes."""

from __future__ import annotations

import itertools
import math
from typing import Any

import pytest
import torch
from backend_cases import BACKENDS, ORACLE, backend_class, simulator_class, stirred
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from torch import Tensor

from cpdeform.core.scene import Scene
from cpdeform.core.simulator import Simulator

LENGTHS = {
    "Sphere": {"radius": 0.03},
    "Capsule": {"radius": 0.025, "height": 0.06},
    "Box": {"half_extents": (0.03, 0.02, 0.04), "rounding": 0.01},
    "Cylinder": {"radius": 0.03, "half_height": 0.03},
    "Torus": {"major_radius": 0.04, "tube_radius": 0.02},
    "RollingPin": {"radius": 0.03, "height": 0.08},
    "Chopsticks": {"radius": 0.02, "height": 0.06, "gap": 0.07},
}
MOTIONS = {"RollingPin": (0.5, 0.3, 0.02), "Chopsticks": (0.02, 0.02, 0.02, 0.3, 0.3, 0.3, 0.01)}
SINGLE_POSITION, SINGLE_COSINE = 1e-5, 0.999
"""How far float32 may be from float64: length units, cosine between gradients."""

SMALLEST_GRADIENT = 1e-6
"""Parts of a gradient shorter than this count for less: nothing but rounding is left of them."""


def number(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(low, high, allow_nan=False)


@st.composite
def tools(draw: st.DrawFn) -> dict[str, Any]:
    """A tool in or near the top of the clay, of any rotation."""
    kind = draw(st.sampled_from(sorted(LENGTHS)))
    turn = [draw(number(-1.0, 1.0)) for _ in range(3)]
    norm = math.sqrt(1.0 + sum(value * value for value in turn))
    motions = MOTIONS.get(kind, (0.02,) * 3 if draw(st.booleans()) else (0.02, 0.02, 0.02, 0.3, 0.3, 0.3))
    return {
        "kind": kind,
        **LENGTHS[kind],
        "position": (draw(number(0.46, 0.54)), draw(number(0.11, 0.15)), draw(number(0.46, 0.54))),
        "rotation_wxyz": (1.0 / norm, *(value / norm for value in turn)),
        "friction": draw(st.sampled_from([0.0, 0.3, 0.9])),
        "action_scale": draw(st.sampled_from([motions, motions, ()])),
    }


@st.composite
def scenes(draw: st.DrawFn) -> Scene:
    """One or two blocks of clay on the floor with one or two tools."""
    count = draw(st.integers(1, 2))
    bodies = [
        {
            "kind": "box",
            "position": (0.5 if count == 1 else 0.46 + 0.08 * index, 0.06, 0.5),
            "widths": (0.12 / count, 0.1, 0.12),
            "particle_count": 100 // count,
            "material": {
                "youngs_modulus": draw(number(1000.0, 8000.0)),
                "poisson_ratio": draw(number(0.1, 0.3)),
                "yield_stress": draw(number(10.0, 400.0)),
            },
        }
        for index in range(count)
    ]
    return Scene.model_validate(
        {
            "bodies": bodies,
            "tools": [draw(tools()) for _ in range(draw(st.integers(1, 2)))],
            "grid_size": 32,
            "substeps": 3,
            "ground_friction": draw(st.sampled_from([0.0, 0.5, 1.5, 100.0])),
            "ground_height": draw(st.sampled_from([0.0, 0.005])),
            "softness": draw(st.sampled_from([0.0, 100.0, 666.0])),
            "sampling_seed": draw(st.integers(0, 1000)),
        }
    )


def follow(simulator: Simulator, seed: int) -> tuple[Tensor, Tensor]:
    """Positions at the end, and the gradient of a random sum of them with respect to the start and the actions, as one vector."""
    generator = torch.Generator().manual_seed(seed)
    state = stirred(simulator, seed=seed)
    shape = (1, 2, simulator.scene.action_size)
    actions = (2.0 * torch.rand(shape, generator=generator, dtype=torch.float64) - 1.0).to(simulator.dtype)
    trajectory = simulator.rollout(state, actions)
    weights = torch.randn(trajectory.positions.shape, generator=generator, dtype=torch.float64).to(simulator.dtype)
    gradient = simulator.vjp(trajectory, weights)
    start = gradient.initial_state
    # each part of length 1: the gradients differ by orders of magnitude
    parts = (gradient.actions, start.position, start.velocity, start.elastic_strain, start.tool_pose)
    flat = [part.double().flatten() for part in parts]
    return trajectory.positions[:, -1].double(), torch.cat([part / part.norm().clamp_min(SMALLEST_GRADIENT) for part in flat])


@pytest.mark.slow
@settings(max_examples=25, suppress_health_check=[HealthCheck.too_slow])
@given(scene=scenes(), seed=st.integers(0, 2**16))
def test_all_simulators_agree(scene: Scene, seed: int) -> None:
    factories = {name: backend_class(name) for name in BACKENDS} | {"example": simulator_class(*ORACLE)}
    double = {name: follow(factory(scene, dtype=torch.float64), seed) for name, factory in factories.items()}
    for first, second in itertools.combinations(double, 2):
        (positions, gradient), (other_positions, other_gradient) = double[first], double[second]
        assert torch.allclose(positions, other_positions, rtol=0.0, atol=1e-9), f"{first}, {second}"
        assert torch.nn.functional.cosine_similarity(gradient, other_gradient, dim=0) > 0.9999, f"{first}, {second}"
    for name in BACKENDS:
        positions, gradient = follow(factories[name](scene, dtype=torch.float32), seed)
        expected_positions, expected_gradient = double[name]
        assert torch.allclose(positions, expected_positions, rtol=0.0, atol=SINGLE_POSITION), name
        assert torch.nn.functional.cosine_similarity(gradient, expected_gradient, dim=0) > SINGLE_COSINE, name
