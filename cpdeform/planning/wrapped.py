"""Simulators that compute their rollouts by another one."""

from __future__ import annotations

from typing import ClassVar

import torch

from cpdeform.core.shapes.kinds import TOOLS
from cpdeform.core.simulator import Simulator, SimulatorCapabilities


class SimulatorWrapped(Simulator):
    """What such simulators share: scene, batch size, device, type and memory are those of the inner one, and so is what it can do.

    Args:
        simulator: Computes the rollouts.
    """

    # The inner simulator has been asked about device, type and tools already.
    capabilities: ClassVar[SimulatorCapabilities] = SimulatorCapabilities(
        differentiable=True,
        devices=("cpu", "cuda"),
        dtypes=(torch.float32, torch.float64),
        tool_kinds=tuple(TOOLS),
        deterministic_devices=(),
    )

    def __init__(self, simulator: Simulator) -> None:
        super().__init__(simulator.scene, batch_size=simulator.batch_size, device=simulator.device, dtype=simulator.dtype)
        self._simulator = simulator

    def release_memory(self) -> None:
        """See `Simulator`."""
        self._simulator.release_memory()
