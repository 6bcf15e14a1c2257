"""Transport priorities of clouds whose optimal transport is known."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from cpdeform.core.errors import InputError
from cpdeform.core.ot import OTSolver
from cpdeform.core.priorities import transport_displacements, transport_priorities
from cpdeform.ot.geomloss import OTSolverGeomLoss
from cpdeform.ot.pot import OTSolverPOT

pytest.importorskip("ot")

MakeSolver = Callable[..., OTSolver]


@pytest.fixture(params=["geomloss", "native", "pot"])
def make(request: pytest.FixtureRequest) -> MakeSolver:
    if request.param == "native":
        return pytest.importorskip("cpdeform_native.ot").OTSolverNative  # type: ignore[no-any-return]
    return {"geomloss": OTSolverGeomLoss, "pot": OTSolverPOT}[request.param]


def rod() -> Tensor:
    """800 points 0.01 apart: 0.5 x 0.04 x 0.04."""
    x, y, z = (torch.arange(count, dtype=torch.float64) * 0.01 for count in (50, 4, 4))
    return torch.cartesian_prod(0.25 + x, y, 0.5 + z)


def bent(points: Tensor) -> Tensor:
    """The rod's left fifth 0.1 aside, and all of it a hundredth to the left: mass goes to the left all along it."""
    aside = torch.where(points[:, 0] < 0.345, 0.1, 0.0)
    return points + torch.stack([torch.full_like(aside, -0.01), torch.zeros_like(aside), aside], dim=1)


def test_a_moved_cloud_is_displaced_by_its_shift(make: MakeSolver) -> None:
    points, shift = rod(), torch.tensor([0.03, 0.1, -0.02], dtype=torch.float64)
    result = make(blur=5e-3, exponent=2).solve(points, points + shift)
    assert torch.allclose(transport_priorities(result), shift.norm().expand(len(points)), rtol=0.02)
    assert torch.allclose(transport_displacements(result), shift.expand(len(points), 3), atol=2e-3)


def test_displacement_is_zero_where_the_clay_stays(make: MakeSolver) -> None:
    points = rod()
    displacement = transport_priorities(make(blur=5e-3, exponent=2).solve(points, points.clone()))
    assert float(displacement.max()) < 1e-4


def test_displacement_finds_the_fault_where_the_potential_finds_the_other_end(make: MakeSolver) -> None:
    points = rod()
    moved = (bent(points) - points).norm(dim=1)
    displacement = transport_priorities(make(blur=5e-3, exponent=2).solve(points, bent(points)))
    away = (points[:, 0] - 0.345).abs() > 0.05  # at the bend the best matching is another one
    assert torch.allclose(displacement[away], moved[away], atol=0.01)
    assert float(points[displacement.argmax(), 0]) < 0.4
    potential = transport_priorities(make(blur=5e-3).solve(points, bent(points)))
    assert float(points[potential.argmax(), 0]) > 0.7
    assert float(moved[potential.argmax()]) == pytest.approx(0.01)


def test_displacement_needs_the_squared_distance() -> None:
    result = OTSolverPOT(blur=0.01).solve(rod()[::20], bent(rod())[::20])
    with pytest.raises(InputError, match=r"result: got a solution of the cost \|x - y\|\^1, .* Give the solver exponent=2"):
        transport_displacements(result)
