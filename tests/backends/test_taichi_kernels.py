"""The Taichi kernels as CUDA runs them, one unit a particle with atomic sums on the whole grid, but on the CPU."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import pytest
import torch
from backend_cases import CASES, actions_for, backend_class, stirred


@pytest.mark.slow
@pytest.mark.parametrize("name", ["two tools", "closing chopsticks"])
def test_the_layout_for_cuda_gives_the_same(name: str) -> None:
    factory = backend_class("taichi")
    from cpdeform.backends.taichi.kernels_substep import build_substep
    from cpdeform.backends.taichi.runtime import ti

    results = []
    for on_cuda in (False, True):
        simulator = factory(CASES[name], batch_size=2)
        program = simulator._program  # type: ignore[attr-defined]
        kernels = SimpleNamespace(**{**vars(program.kernels), **vars(build_substep(ti.f32, on_cuda))})
        simulator._program = dataclasses.replace(program, kernels=kernels, on_cuda=on_cuda)  # type: ignore[attr-defined]
        trajectory = simulator.rollout(stirred(simulator, batch_size=2), actions_for(simulator, batch_size=2))
        gradient = simulator.vjp(trajectory, torch.ones_like(trajectory.positions))
        results.append((trajectory.positions, gradient.actions, gradient.initial_state.velocity))
    for plain, other in zip(*results, strict=True):
        assert (plain - other).abs().max() <= 1e-5 * plain.abs().max()
