"""Clouds whose points are all at one place, where a cloud has no diameter."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch

from cpdeform.core.ot import OTSolver
from cpdeform.ot.geomloss import OTSolverGeomLoss
from cpdeform.ot.pot import OTSolverPOT
from cpdeform.ot.schedule import geomloss_blurs

SOLVERS: dict[str, Callable[..., OTSolver]] = {
    "pot": OTSolverPOT,
    "geomloss": OTSolverGeomLoss,
    "geomloss, squared": lambda: OTSolverGeomLoss(exponent=2),
    "geomloss, as in the paper": lambda: OTSolverGeomLoss(settings="paper"),
}


@pytest.mark.parametrize("sizes", [(20, 20), (1, 1), (30, 7)])
@pytest.mark.parametrize("name", SOLVERS)
def test_nothing_has_to_move(name: str, sizes: tuple[int, int]) -> None:
    source, target = (torch.tensor([0.3, 0.2, 0.7], dtype=torch.float64).expand(size, 3).clone() for size in sizes)
    result = SOLVERS[name]().solve(source, target)
    assert float(result.value) == pytest.approx(0.0, abs=1e-12)
    assert torch.allclose(result.source_potential, torch.zeros(sizes[0], dtype=torch.float64), atol=1e-12)
    assert torch.allclose(result.target_potential, torch.zeros(sizes[1], dtype=torch.float64), atol=1e-12)
    assert torch.allclose(result.source_gradient, torch.zeros(sizes[0], 3, dtype=torch.float64), atol=1e-12)


def test_many_equal_points_take_the_chunked_schedule_of_the_paper() -> None:
    points = torch.full((2100, 3), 0.4, dtype=torch.float64)
    result = OTSolverGeomLoss(settings="paper").solve(points, points)
    assert float(result.value) == pytest.approx(0.0, abs=1e-12)
    assert geomloss_blurs(0.0, 1e-3, 0.5) == [1e-3, 1e-3]


def test_a_cloud_at_one_place_costs_the_way_to_another() -> None:
    source = torch.full((20, 3), 0.4, dtype=torch.float64)
    result = OTSolverGeomLoss().solve(source, source + torch.tensor([0.1, 0.0, 0.0], dtype=torch.float64))
    assert float(result.value) == pytest.approx(0.1, rel=1e-6)
