"""Functions of symmetric matrices and the material law against finite differences, equal eigenvalues included."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from cpdeform.core.scene import Scene
from cpdeform_example.material import Material, isotropic, symmetric

STRAINS = {
    "rest": (0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    "three equal": (0.03, 0.03, 0.03, 0.0, 0.0, 0.0),
    "two equal": (0.02, 0.02, -0.01, 0.0, 0.0, 0.0),
    "nearly equal": (0.02, 0.02 + 1e-7, -0.01, 0.0, 0.0, 1e-9),
    "yielding, two equal": (0.2, 0.2, -0.1, 0.0, 0.0, 0.0),
    "yielding": (0.2, -0.15, 0.1, 0.04, -0.05, 0.02),
    "crushed": (-0.9985, 0.3, 0.2, 0.0, 0.0, 0.0),
}


def law() -> Material:
    body = {"kind": "box", "position": (0.5, 0.5, 0.5), "widths": (0.1, 0.1, 0.1), "particle_count": 1}
    material = {"youngs_modulus": 5.0, "poisson_ratio": 0.3, "yield_stress": 0.2}
    scene = Scene.model_validate({"bodies": [body], "material": material})
    return Material(scene, dtype=torch.float64, device=torch.device("cpu"))


@pytest.mark.parametrize("name", STRAINS)
def test_gradient_equals_finite_differences(name: str) -> None:
    material = law()
    strain = torch.tensor([[STRAINS[name]]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda e: isotropic(material.principal, symmetric(e)), strain, atol=1e-6, rtol=1e-6)


def test_isotropic_is_the_matrix_function() -> None:
    generator = torch.Generator().manual_seed(0)
    matrix = torch.randn(5, 3, 3, generator=generator, dtype=torch.float64)
    matrix = 0.1 * (matrix + matrix.mT)

    def exponential(values: Tensor) -> Tensor:
        return values.exp().unsqueeze(-2)

    assert torch.allclose(isotropic(exponential, matrix)[:, 0], torch.linalg.matrix_exp(matrix), atol=1e-13, rtol=0.0)


def test_stress_obeys_the_yield_criterion_and_strain_inside_stays() -> None:
    material = law()
    strain = torch.tensor([[STRAINS["yielding"]]], dtype=torch.float64)
    nothing = torch.zeros(1, 1, 3, 3, dtype=torch.float64)
    new, _ = material.respond(strain, nothing, 1e-4)
    hencky = 0.5 * torch.log1p(torch.linalg.eigvalsh(symmetric(new)))
    limit = 0.2 / (5.0 / 1.3)
    assert float((hencky - hencky.mean()).norm()) == pytest.approx(limit, rel=1e-4)
    small = torch.tensor([[STRAINS["nearly equal"]]], dtype=torch.float64)
    assert torch.allclose(material.respond(small, nothing, 1e-4)[0], small, atol=1e-16, rtol=0.0)
