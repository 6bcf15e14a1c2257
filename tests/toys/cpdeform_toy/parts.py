"""Transport and placement to go with the toy simulator."""

from __future__ import annotations

import torch

from cpdeform.core.ot import OTCapabilities, OTResult, OTSolver, check_problem, fix_gauge
from cpdeform.core.placer import Placer, PlacerCapabilities, Proposal


class OTSolverToy(OTSolver):
    """Transport with squared cost between the centres of mass; the potential is each particle's share."""

    capabilities = OTCapabilities(
        potentials="entropic", debiased=True, warm_start=False, devices=("cpu", "cuda"), potential_tolerance=1.0
    )

    def __init__(self, *, blur: float = 1e-3) -> None:
        self.blur = float(blur)

    def solve(self, source, target, *, source_weights=None, target_weights=None, previous=None) -> OTResult:
        a, b = check_problem(source, target, source_weights, target_weights)
        difference = a @ source - b @ target
        value = (difference**2).sum()
        f, g = fix_gauge(2.0 * source @ difference, -2.0 * target @ difference, a)
        return OTResult(value, f, g, 2.0 * a[:, None] * difference, True, 1, 0.0, self.blur, exponent=2)


class OTSolverExactToy(OTSolverToy):
    """Declares what no placer accepts as priorities."""

    capabilities = OTCapabilities(potentials="exact", debiased=True, warm_start=False, devices=("cpu",), potential_tolerance=1.0)


class PlacerToy(Placer):
    """Puts the first tool at several distances from where it is.

    Args:
        count: Number of candidates; none, if zero.
        spacing: Distance between them along x, length units.
        rounds: How often to ask again.
    """

    capabilities = PlacerCapabilities(needs_priorities=True, max_tools=1)

    def __init__(self, *, count: int = 3, spacing: float = 0.1, rounds: int = 1) -> None:
        self.count, self.spacing, self.rounds = count, spacing, rounds
        self.told: list[list[float]] = []

    def ask(self, stage) -> list[Proposal]:
        assert torch.isfinite(stage.priorities).all()
        particle = int(stage.priorities.argmax())
        placements = []
        for index in range(self.count):
            pose = stage.state.tool_pose[0].clone()
            pose[0, 0] += self.spacing * (index + 1)
            placements.append(Proposal(pose, float(stage.priorities.max()), f"candidate-{index}", particle))
        return placements

    def tell(self, results) -> bool:
        self.told.append([result.loss for result in results])
        return len(self.told) % self.rounds != 0


class PlacerFixedToy(PlacerToy):
    """Leaves the tools where they are and needs no priorities."""

    capabilities = PlacerCapabilities(needs_priorities=False, max_tools=None)

    def ask(self, stage) -> list[Proposal]:
        return [Proposal(stage.state.tool_pose[0], float("nan"), "fixed")]
