"""The material: trial strain, return mapping, stress, and functions of symmetric matrices with a gradient at equal eigenvalues.

References:
    de Souza Neto, Peric, Owen, "Computational Methods for Plasticity", 2008, chapter 14 and appendix A (isotropic functions).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from cpdeform.core.sampling import body_index
from cpdeform.core.scene import Scene
from cpdeform.core.state import STRAIN_COMPONENTS

SMALLEST_STRETCH = 0.05
NORM_REGULARIZATION = 1e-8
ROWS = [row for row, _ in STRAIN_COMPONENTS]
COLUMNS = [column for _, column in STRAIN_COMPONENTS]


class Material:
    """Elastoplastic response of a scene's particles.

    Args:
        scene: Whose bodies' materials to use.
        dtype: Floating-point type.
        device: Where the tensors live.
    """

    def __init__(self, scene: Scene, *, dtype: torch.dtype, device: torch.device) -> None:
        bodies = [scene.material_of(index) for index in range(len(scene.bodies))]
        table = torch.tensor([[item.shear_modulus, item.lame_lambda, item.yield_stress] for item in bodies], dtype=torch.float64)
        constants = table[torch.as_tensor(body_index(scene), dtype=torch.long)].to(dtype=dtype, device=device)
        # (N, 1): one row a particle, to broadcast with the three eigenvalues
        self._shear, self._lame, self._yield_stress = (column.unsqueeze(-1) for column in constants.unbind(-1))

    def respond(self, strain: Tensor, affine: Tensor, time_step: float) -> tuple[Tensor, Tensor]:
        """Deform the particles for one substep.

        Args:
            strain: Elastic strain (B, N, 6), see `State.elastic_strain`.
            affine: Affine velocity field (B, N, 3, 3), 1/second.
            time_step: Seconds.

        Returns:
            The new elastic strain (B, N, 6) and the Kirchhoff stress (B, N, 3, 3).
        """
        trial = trial_strain(symmetric(strain), time_step * affine)
        # An eigensolver refuses nan. A world that has left the numbers must stay visible as nan, and leave the others alone.
        broken = ~torch.isfinite(trial).all(dim=-1).all(dim=-1)[..., None, None]
        results = isotropic(self.principal, torch.where(broken, 0.0, trial))
        new, stress = (torch.where(broken, torch.nan, result) for result in results.unbind(-3))
        return new[..., ROWS, COLUMNS], stress

    def principal(self, trial: Tensor) -> Tensor:
        """New strains and stresses in the principal frame.

        Args:
            trial: Eigenvalues (B, N, 3) of the trial strain b - I.

        Returns:
            Eigenvalues (B, N, 2, 3) of the new strain (first) and of the Kirchhoff stress (second).
        """
        hencky = 0.5 * torch.log1p(trial.clamp(min=SMALLEST_STRETCH**2 - 1.0))
        mean = hencky.mean(dim=-1, keepdim=True)
        deviator = hencky - mean
        norm = (deviator.square().sum(dim=-1, keepdim=True) + NORM_REGULARIZATION).sqrt()
        limit = self._yield_stress / (2.0 * self._shear)
        mapped = torch.expm1(mean + limit / norm * deviator)
        elastic = trial / (1.0 + (1.0 + trial).clamp(min=1e-12).sqrt())
        yields = norm > limit
        # a = stretch - 1, so that small strains keep their digits
        a = torch.where(yields, mapped, elastic)
        new = torch.where(yields, a * (2.0 + a), trial)
        volume_ratio = (1.0 + a).prod(dim=-1, keepdim=True)
        stress = 2.0 * self._shear * a * (1.0 + a) + self._lame * volume_ratio * (volume_ratio - 1.0)
        return torch.stack([new, stress], dim=-2)


def symmetric(entries: Tensor) -> Tensor:
    """Symmetric matrices (..., 3, 3) of the six numbers (..., 6) of `State.elastic_strain`."""
    return entries[..., [0, 3, 4, 3, 1, 5, 4, 5, 2]].reshape(*entries.shape[:-1], 3, 3)


def trial_strain(strain: Tensor, increment: Tensor) -> Tensor:
    """(I + D)(I + e)(I + D)^T - I, written without the cancellation; strain e and increment D are (..., 3, 3)."""
    product = increment @ strain
    return strain + increment + increment.mT + product + product.mT + (increment + product) @ increment.mT


def isotropic(function: Callable[[Tensor], Tensor], matrix: Tensor) -> Tensor:
    """Apply isotropic functions to symmetric matrices.

    Args:
        function: From eigenvalues (..., 3) to values (..., K, 3) of K functions, made of torch operations. Permuting the
            eigenvalues must permute the values alike.
        matrix: Symmetric matrices (..., 3, 3).

    Returns:
        The matrices (..., K, 3, 3) with the eigenvectors of `matrix` and the new values. The gradient is exact and finite also
        where eigenvalues meet, which that of `torch.linalg.eigh` is not; second derivatives are not available.
    """
    result: Tensor = _Isotropic.apply(function, matrix)  # type: ignore[no-untyped-call]
    return result


class _Isotropic(torch.autograd.Function):
    """`isotropic`, with the Daleckii-Krein formula for its gradient."""

    @staticmethod
    def forward(ctx: Any, function: Callable[[Tensor], Tensor], matrix: Tensor) -> Tensor:
        """Compose the eigenvectors with the function's values."""
        values, vectors = torch.linalg.eigh(matrix)
        ctx.function = function
        ctx.save_for_backward(values, vectors)
        frames = vectors.unsqueeze(-3)
        result: Tensor = (frames * function(values).unsqueeze(-2)) @ frames.mT
        return result

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[None, Tensor]:
        """Weigh the gradient, seen from the eigenvectors, by derivatives on the diagonal and divided differences off it."""
        values, vectors = ctx.saved_tensors
        results, jacobian = _jacobian(ctx.function, values)
        frames = vectors.unsqueeze(-3)
        turned = frames.mT @ (0.5 * (grad + grad.mT)) @ frames
        mixed = (divided_differences(values, results, jacobian) * turned).sum(dim=-3)
        along = torch.einsum("...kii,...kij->...j", turned, jacobian)
        inner = torch.where(torch.eye(3, dtype=torch.bool, device=values.device), along.unsqueeze(-1), mixed)
        result: Tensor = vectors @ inner @ vectors.mT
        return None, result


def _jacobian(function: Callable[[Tensor], Tensor], values: Tensor) -> tuple[Tensor, Tensor]:
    """A function's results (..., K, 3) of eigenvalues (..., 3) and its derivatives (..., K, 3, 3), the eigenvalue's axis last."""
    with torch.enable_grad():
        values = values.detach().requires_grad_()
        results = function(values)
        flat = results.flatten(-2)
        rows = [torch.autograd.grad(flat[..., row].sum(), values, retain_graph=True)[0] for row in range(flat.shape[-1])]
    return results.detach(), torch.stack(rows, dim=-2).reshape(*results.shape, 3)


def divided_differences(values: Tensor, results: Tensor, jacobian: Tensor) -> Tensor:
    """(f_i - f_j) / (x_i - x_j), or its limit where the eigenvalues x_i and x_j are too close to subtract.

    Args:
        values: Eigenvalues x (..., 3).
        results: Values f (..., K, 3).
        jacobian: Derivatives of f by x (..., K, 3, 3).

    Returns:
        Symmetric matrices (..., K, 3, 3); their diagonal is not meaningful.
    """
    gap = (values.unsqueeze(-1) - values.unsqueeze(-2)).unsqueeze(-3)
    # Rounding costs eps / gap, the limit gap^2: the cube root balances them.
    close = gap.abs() < torch.finfo(values.dtype).eps ** (1.0 / 3.0)
    own = torch.diagonal(jacobian, dim1=-2, dim2=-1)
    limit = 0.5 * (own.unsqueeze(-1) + own.unsqueeze(-2) - jacobian - jacobian.mT)
    return torch.where(close, limit, (results.unsqueeze(-1) - results.unsqueeze(-2)) / torch.where(close, 1.0, gap))
