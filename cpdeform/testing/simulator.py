"""`check_simulator`: does a backend keep the contract of `Simulator`?"""

from __future__ import annotations

from collections.abc import Sequence

import torch

from cpdeform.core.scene import Scene
from cpdeform.core.simulator import Simulator
from cpdeform.testing.report import Check, Report, choose, run_checks
from cpdeform.testing.simulator_bench import (
    SimulatorBench,
    SimulatorFactory,
    complain_about_scene,
    default_scene,
    resting,
)
from cpdeform.testing.simulator_chain import CHAIN_CHECKS
from cpdeform.testing.simulator_contract import CONTRACT_CHECKS
from cpdeform.testing.simulator_gradient import GRADIENT_CHECKS
from cpdeform.testing.simulator_ownership import OWNERSHIP_CHECKS
from cpdeform.testing.simulator_physics import PHYSICS_CHECKS

SIMULATOR_CHECKS = (*CONTRACT_CHECKS, *OWNERSHIP_CHECKS, *PHYSICS_CHECKS, *GRADIENT_CHECKS, *CHAIN_CHECKS)


def check_simulator(
    factory: SimulatorFactory, *, scene: Scene | None = None, device: torch.device | str = "cpu", only: Sequence[str] = ()
) -> Report:
    """Check a simulator: contract, physics, and gradients against central differences.

    It is tested in double precision where it declares that, otherwise in its default type with wider bounds.

    Args:
        factory: Called as ``factory(scene, batch_size=..., device=..., dtype=...)``: a `Simulator` class, or a partial of one.
        scene: Scene of the checks that need no particular one (shapes, states, batches, gradients); defaults to a block of
            300 particles on the floor with two tools of the first declared kinds.
        device: Where to test.
        only: Run only the checks of these names, or whose names contain these texts.

    Returns:
        What was found; `Report.raise_if_failed` turns failures into an error.

    Raises:
        InputError: `scene` is not a scene, or no check has a name that `only` asks for.
    """
    items = choose(SIMULATOR_CHECKS, only)
    complain_about_scene(scene)
    name = getattr(getattr(factory, "func", factory), "__name__", type(factory).__name__)
    try:
        first = factory(resting(), batch_size=1, device=device, dtype=None)
        if not isinstance(first, Simulator):
            raise TypeError(f"it is a {type(first).__name__}, not a cpdeform.core.simulator.Simulator")
        capabilities = first.capabilities
        bench = SimulatorBench(factory, capabilities, torch.device(device), scene or default_scene(capabilities.tool_kinds))
    except Exception as error:
        advice = f"factory(scene, batch_size=1, device=..., dtype=None) raised {type(error).__name__}: {error}"
        return Report(name, (Check("it can be built", "failed", advice=advice),))
    return run_checks(name, items, bench)
