"""Quaternions against rotation matrices and the exponential map."""

from __future__ import annotations

import math

import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from cpdeform.core.rotation import conjugate, from_rotation_vector, multiply, rotate, rotate_inverse

COMPONENT = st.floats(-3.0, 3.0, allow_nan=False)
VECTOR = st.tuples(COMPONENT, COMPONENT, COMPONENT).map(lambda values: torch.tensor(values, dtype=torch.float64))


def cross_matrix(vector: Tensor) -> Tensor:
    x, y, z = vector.tolist()
    return torch.tensor([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]], dtype=torch.float64)


@settings(deadline=None, max_examples=50)
@given(VECTOR, VECTOR)
def test_rotation_vector_is_the_matrix_exponential(rotation: Tensor, vector: Tensor) -> None:
    expected = torch.linalg.matrix_exp(cross_matrix(rotation)) @ vector
    assert torch.allclose(rotate(from_rotation_vector(rotation), vector), expected, atol=1e-9)


@settings(deadline=None, max_examples=50)
@given(VECTOR, VECTOR, VECTOR)
def test_product_composes_and_inverse_undoes(first: Tensor, second: Tensor, vector: Tensor) -> None:
    left, right = from_rotation_vector(first), from_rotation_vector(second)
    assert torch.allclose(rotate(multiply(left, right), vector), rotate(left, rotate(right, vector)), atol=1e-9)
    assert torch.allclose(rotate_inverse(left, rotate(left, vector)), vector, atol=1e-9)
    identity = multiply(left, conjugate(left))
    assert torch.allclose(identity, torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=torch.float64), atol=1e-12)


def test_known_turn() -> None:
    quarter = from_rotation_vector(torch.tensor([0.0, 0.0, math.pi / 2], dtype=torch.float64))
    turned = rotate(quarter, torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64))
    assert torch.allclose(turned, torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64), atol=1e-12)


def test_leading_axes_broadcast() -> None:
    quaternions = from_rotation_vector(torch.randn(4, 1, 3, dtype=torch.float64))
    vectors = torch.randn(5, 3, dtype=torch.float64)
    turned = rotate(quaternions, vectors)
    assert turned.shape == (4, 5, 3)
    assert torch.allclose(turned[2, 3], rotate(quaternions[2, 0], vectors[3]))


def test_gradient_is_right_at_zero_and_across_the_series() -> None:
    zero = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    jacobian = torch.autograd.functional.jacobian(from_rotation_vector, zero)
    assert torch.equal(jacobian, torch.cat([torch.zeros(1, 3), 0.5 * torch.eye(3)]).double())
    for size in (0.0, 1e-6, 9.99e-5, 1.001e-4, 1e-2, 1.0):
        vector = (size * torch.tensor([0.6, 0.0, -0.8], dtype=torch.float64)).requires_grad_()
        assert torch.autograd.gradcheck(from_rotation_vector, (vector,))
        assert abs(float(from_rotation_vector(vector.detach()).norm()) - 1.0) < 1e-12
