"""The Warp backend against recorded trajectories and gradients of PlasticineLab (float64)."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from golden import SCENES, load_golden

from cpdeform.backends.warp.simulator import SimulatorWarp
from cpdeform.core.objectives.plasticinelab import ObjectivePlasticineLab


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENES)
def test_positions_velocities_and_gradient_are_plasticinelabs(name: str) -> None:
    golden = load_golden(name)
    simulator = SimulatorWarp(golden.scene)
    trajectory = simulator.rollout(golden.state, golden.actions)
    position = trajectory.positions[0, -1].double().numpy()
    assert np.abs(position - golden.arrays["x"]).max() < 1e-4
    velocity = trajectory.final_state.velocity[0].double().numpy()
    assert np.linalg.norm(velocity - golden.arrays["v"]) < 1e-2 * np.linalg.norm(golden.arrays["v"])
    recorded = torch.as_tensor(golden.arrays["grad"])
    if golden.target_grid is None or not torch.isfinite(recorded).all():
        return
    result = ObjectivePlasticineLab(golden.scene, golden.target_grid.float()).evaluate(trajectory)
    gradient = simulator.vjp(trajectory, result.grad_positions, result.grad_manipulators).actions[0].double()
    assert float(result.loss[0]) == pytest.approx(float(golden.arrays["total_loss"]), rel=1e-4)
    cosine = torch.nn.functional.cosine_similarity(gradient.flatten(), recorded.flatten(), dim=0)
    assert float(cosine) > 0.999
    assert float(gradient.norm()) == pytest.approx(float(recorded.norm()), rel=0.02)
