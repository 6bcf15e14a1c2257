"""The node masses: conservation, B-spline values, adjoint."""

from __future__ import annotations

import pytest
import torch

from cpdeform.core.errors import InputError
from cpdeform.core.scene import BodyBox, Scene
from cpdeform.planning.objectives import mass
from cpdeform.planning.objectives.mass import mass_grid

SCENE = Scene(bodies=(BodyBox(position=(0.5, 0.5, 0.5), widths=(0.2, 0.2, 0.2), particle_count=10),), grid_size=16)


def points(*shape: int, seed: int = 0) -> torch.Tensor:
    uniform = torch.rand(*shape, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    return uniform * (1.0 - 3.0 / 16)


def nodes() -> torch.Tensor:
    axis = torch.arange(16, dtype=torch.float64) / 16
    return torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1)


def test_mass_and_first_moment_are_kept_down_to_the_floor() -> None:
    positions = points(200)
    positions[0] = 0.0
    grid = mass_grid(positions, SCENE)
    assert torch.allclose(grid.sum(), torch.tensor(200 * SCENE.particle_volume).double(), rtol=1e-12)
    moment = (grid.unsqueeze(-1) * nodes()).sum(dim=(0, 1, 2))
    assert torch.allclose(moment, SCENE.particle_volume * positions.sum(dim=0), rtol=1e-12)


def test_single_particle_has_b_spline_weights() -> None:
    grid = mass_grid(torch.tensor([[5.0, 5.5, 6.25]], dtype=torch.float64) / 16, SCENE) / SCENE.particle_volume
    x = torch.tensor([0.125, 0.75, 0.125], dtype=torch.float64)
    y = torch.tensor([0.5, 0.5, 0.0], dtype=torch.float64)
    z = torch.tensor([0.5 * 0.25**2, 0.75 - 0.25**2, 0.5 * 0.75**2], dtype=torch.float64)
    assert torch.allclose(grid[4:7, 5:8, 5:8], torch.einsum("i,j,k->ijk", x, y, z), atol=1e-15)
    assert torch.allclose(grid[4:7, 5:8, 5:8].sum(), grid.sum())


def test_base_is_truncated_towards_zero() -> None:
    """PlasticineLab's quirk: below dx/2 the first cell's weights are extrapolated, one of them below zero."""
    grid = mass_grid(torch.tensor([[8.0, 0.0, 8.0]], dtype=torch.float64) / 16, SCENE) / SCENE.particle_volume
    assert torch.allclose(grid[8, :4, 8] / 0.75**2, torch.tensor([1.125, -0.25, 0.125, 0.0], dtype=torch.float64))


def test_leading_axes_and_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    positions = points(2, 3, 40)
    whole = mass_grid(positions, SCENE)
    assert whole.shape == (2, 3, 16, 16, 16)
    monkeypatch.setattr(mass, "CHUNK_ENTRIES", 27 * 7)
    assert torch.allclose(mass_grid(positions, SCENE), whole, atol=1e-15)
    assert torch.allclose(mass_grid(positions[1, 2], SCENE), whole[1, 2], atol=1e-15)


def test_gradient_matches_finite_differences() -> None:
    positions = points(2, 4)
    positions[0, 0, 1] = 0.01
    masks = torch.rand(3, 16, 16, 16, dtype=torch.float64, generator=torch.Generator().manual_seed(1))

    def weighted(x: torch.Tensor) -> torch.Tensor:
        return torch.einsum("fijk,mijk->fm", 1e3 * mass_grid(x, SCENE), masks)

    assert torch.autograd.gradcheck(weighted, (positions.requires_grad_(),))


@pytest.mark.parametrize("bad", [float("nan"), -0.1, 1.1])
def test_particles_outside_are_counted(bad: float) -> None:
    positions = points(5)
    positions[3, 1] = bad
    with pytest.raises(InputError, match="1 particles outside the domain"):
        mass_grid(positions, SCENE)


def test_wrong_shape_is_named() -> None:
    with pytest.raises(InputError, match="positions: got shape"):
        mass_grid(torch.zeros(3), SCENE)
