"""The native transport solver: contract, agreement with the other solvers, closed forms, exact cost, errors."""

from __future__ import annotations

import importlib
import math
import sys

import pytest
import torch
from scipy.optimize import linear_sum_assignment
from torch import Tensor

import cpdeform_native
from cpdeform.core.errors import InputError, MissingExtraError
from cpdeform.core.ot import weighted_median
from cpdeform.core.plugins import load_registry
from cpdeform.ot.divergence import Potentials, Problem
from cpdeform.testing.ot import check_ot_solver
from cpdeform.testing.ot_bench import cloud, cosine, pressed, random_weights
from cpdeform_native.ot import OTSolverNative


def exact_cost(source: Tensor, target: Tensor) -> float:
    cost = torch.cdist(source.double(), target.double()).numpy()
    return float(cost[linear_sum_assignment(cost)].mean())


# Contract -----------------------------------------------------------------------------------------------------------------


def test_conformance() -> None:
    check_ot_solver(OTSolverNative).raise_if_failed()


def test_conformance_with_squared_distances() -> None:
    check_ot_solver(lambda: OTSolverNative(exponent=2, blur=2e-2)).raise_if_failed()


def test_registered_name() -> None:
    solver = load_registry().create("ot_solver", "native", blur=2e-3)
    assert isinstance(solver, OTSolverNative)
    assert solver.blur == 2e-3


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_strided_inputs_that_require_gradients(dtype: torch.dtype) -> None:
    source, target = cloud(70, seed=1).to(dtype), cloud(60, seed=2).to(dtype)
    solver = OTSolverNative(blur=5e-3)
    straight = solver.solve(source, target)
    wide = torch.stack([source, source], dim=2).requires_grad_()
    strided = solver.solve(wide[:, :, 0], target.T.contiguous().T)
    assert torch.equal(straight.source_gradient, strided.source_gradient)
    assert straight.source_gradient.dtype == dtype
    assert not strided.value.requires_grad


# Agreement with others ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("other", ["pot", "geomloss"])
@pytest.mark.parametrize("changed", ["stroke", "random"])
@pytest.mark.parametrize(("exponent", "blur", "debias"), [(1, 2e-3, True), (1, 5e-3, False), (2, 3e-2, True)])
def test_agrees_with_other_solvers(other: str, changed: str, exponent: int, blur: float, debias: bool) -> None:
    pytest.importorskip({"pot": "ot"}.get(other, other))
    source = cloud(200, seed=21)
    target = pressed(source) if changed == "stroke" else cloud(180, seed=22) * 0.9 + 0.03
    weights = random_weights(target.shape[0], seed=3)
    options = {"blur": blur, "exponent": exponent, "debias": debias, "tolerance": 1e-5}
    first = OTSolverNative(**options).solve(source, target, target_weights=weights)
    second = load_registry().create("ot_solver", other, **options).solve(source, target, target_weights=weights)
    assert float(first.value) == pytest.approx(float(second.value), rel=2e-3)
    assert cosine(first.source_gradient, second.source_gradient) > 0.999
    for mine, theirs in ((first.source_potential, second.source_potential), (first.target_potential, second.target_potential)):
        spread = float(theirs.max() - theirs.min())
        assert float((mine - theirs).abs().max()) < 0.02 * spread


@pytest.mark.parametrize(("exponent", "blur"), [(1, 1e-2), (1, 1e-3), (2, 3e-2), (2, 5e-3)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_truncated_soft_minima_are_those_of_all_pairs(exponent: int, blur: float, dtype: torch.dtype) -> None:
    """Potentials and gradient against equation (1) of `cpdeform.ot.softmin` over all pairs, a far outlier among them."""
    source, target = cloud(300, seed=4).to(dtype), cloud(200, seed=5).to(dtype)
    source[7] += 3.0
    result = OTSolverNative(blur=blur, exponent=exponent, debias=False, tolerance=1e-3).solve(source, target)
    state = result.warm_state
    assert isinstance(state, Potentials)
    problem = Problem.of(source.double(), target.double(), None, None, blur, exponent)
    updated, gradient = problem.source_update_gradient(state.target.double())
    rounding = 4.0 * torch.finfo(dtype).eps * float(updated.abs().max())
    assert float((updated - state.source).abs().max()) < rounding + 1e-6 * problem.epsilon
    assert cosine(gradient / 300, result.source_gradient) > 1 - 1e-6


@pytest.mark.parametrize("changed", ["stroke", "random"])
def test_potentials_are_those_of_the_tightly_converged_problem(changed: str) -> None:
    source = cloud(200, seed=23)
    target = pressed(source) if changed == "stroke" else cloud(200, seed=24) + 0.02
    usual = OTSolverNative(blur=2e-3).solve(source, target)
    tight = OTSolverNative(blur=2e-3, scaling=0.8, tolerance=1e-7, iterations=20000).solve(source, target)
    assert tight.converged
    spread = float(tight.source_potential.max() - tight.source_potential.min())
    difference = float((usual.source_potential - tight.source_potential).abs().max())
    assert difference < OTSolverNative.capabilities.potential_tolerance * spread


def test_single_precision_agrees_with_double() -> None:
    source, target = cloud(500, seed=17), cloud(500, seed=18) + 0.02
    solver = OTSolverNative(blur=2e-3)
    double, single = solver.solve(source, target), solver.solve(source.float(), target.float())
    assert float(single.value) == pytest.approx(float(double.value), rel=1e-4)
    assert cosine(single.source_gradient, double.source_gradient) > 0.9999
    assert torch.allclose(single.source_potential.double(), double.source_potential, atol=1e-4)


# Closed forms -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_equal_clouds_are_at_distance_zero(dtype: torch.dtype) -> None:
    source = cloud(3000, seed=5).to(dtype)
    result = OTSolverNative(blur=2e-3).solve(source, source.clone())
    assert abs(float(result.value)) < 1e-6
    assert float(result.source_potential.abs().max()) < 1e-5
    assert float(result.source_gradient.abs().max()) < 1e-3 / 3000
    assert result.converged


def test_translation_costs_its_length() -> None:
    axis = torch.linspace(0, 0.02, 5, dtype=torch.float64)
    source = torch.cartesian_prod(axis, axis, axis)[:120]
    shift = torch.tensor([0.6, 0.0, 0.8], dtype=torch.float64)
    result = OTSolverNative(blur=4e-4).solve(source, source + shift)
    assert float(result.value) == pytest.approx(1.0, abs=4e-4 * math.log(120))
    assert torch.allclose(result.source_gradient, -shift.expand(120, 3) / 120, atol=0.03 / 120)


def test_points_on_a_line_are_matched_in_order() -> None:
    generator = torch.Generator().manual_seed(2)
    first, second = (torch.rand(100, generator=generator, dtype=torch.float64) for _ in range(2))
    source, target = (torch.stack([x, 0 * x + 0.5, 0 * x], dim=1) for x in (first, second))
    result = OTSolverNative(blur=1e-4).solve(source, target)
    assert float(result.value) == pytest.approx(float((first.sort().values - second.sort().values).abs().mean()), rel=0.01)


def test_two_weighted_points_ship_the_surplus() -> None:
    points = torch.tensor([[0.0, 0.0, 0.0], [0.3, 0.0, 0.4]], dtype=torch.float64)
    first, second = torch.tensor([0.7, 0.3], dtype=torch.float64), torch.tensor([0.4, 0.6], dtype=torch.float64)
    result = OTSolverNative(blur=1e-3).solve(points, points, source_weights=first, target_weights=second)
    assert float(result.value) == pytest.approx(0.15, rel=0.005)
    assert float(result.source_potential[0] - result.source_potential[1]) == pytest.approx(0.5, rel=0.005)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("changed", ["stroke", "random"])
def test_exact_cost_at_a_small_blur(dtype: torch.dtype, changed: str) -> None:
    source = cloud(1000, seed=41)
    target = pressed(source) if changed == "stroke" else cloud(1000, seed=42) + 0.02
    result = OTSolverNative(blur=1e-4, tolerance=1e-3).solve(source.to(dtype), target.to(dtype))
    assert result.converged
    assert float(result.value) == pytest.approx(exact_cost(source, target), rel=0.01)


# Degenerate inputs --------------------------------------------------------------------------------------------------------


def test_single_points() -> None:
    source, target = torch.zeros(1, 3), torch.tensor([[0.3, 0.0, 0.4]])
    result = OTSolverNative().solve(source, target)
    assert float(result.value) == pytest.approx(0.5, rel=1e-5)
    assert torch.allclose(result.source_gradient, torch.tensor([[-0.6, 0.0, -0.8]]), atol=1e-5)
    assert float(OTSolverNative().solve(source, source.clone()).value) == 0.0


def test_one_point_against_many() -> None:
    target = cloud(50, seed=1)
    source = torch.zeros(1, 3, dtype=torch.float64)
    result = OTSolverNative(blur=1e-3, debias=False).solve(source, target)
    assert float(result.value) == pytest.approx(float(target.norm(dim=1).mean()), rel=1e-9)


def test_coincident_points() -> None:
    source = torch.full((40, 3), 0.5)
    target = torch.full((33, 3), 0.5) + torch.tensor([0.0, 0.1, 0.0])
    result = OTSolverNative().solve(source, target)
    assert float(result.value) == pytest.approx(0.1, rel=1e-4)
    assert torch.allclose(result.source_gradient, torch.tensor([0.0, -1.0, 0.0]).expand(40, 3) / 40, atol=1e-5)


@pytest.mark.parametrize("count", [15, 16, 17, 2001])
def test_points_without_weight_change_nothing(count: int) -> None:
    source, target = cloud(100, seed=10), cloud(100, seed=11) + 0.02
    weights = torch.cat([torch.full((100,), 0.01, dtype=torch.float64), torch.zeros(count, dtype=torch.float64)])
    extended = torch.cat([source, cloud(count, seed=12)])
    plain = OTSolverNative(blur=3e-3).solve(source, target)
    padded = OTSolverNative(blur=3e-3).solve(extended, target, source_weights=weights)
    assert float(padded.value) == pytest.approx(float(plain.value), rel=1e-3)
    assert bool(torch.isfinite(padded.source_potential).all())
    assert float(padded.source_gradient[100:].abs().max()) == 0
    assert float(weighted_median(padded.source_potential, weights)) == pytest.approx(0, abs=1e-12)


# Errors -------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "word"),
    [
        ({"blur": 0.0}, "blur"),
        ({"blur": math.nan}, "blur"),
        ({"exponent": 3}, "exponent"),
        ({"tolerance": 0.0}, "tolerance"),
        ({"iterations": 0}, "iterations"),
        ({"scaling": 1.0}, "scaling"),
        ({"warm_iterations": 0}, "warm_iterations"),
        ({"warm_tolerance": 0.0}, "warm_tolerance"),
        ({"threads": 0}, "threads"),
        ({"instruction_set": "mmx"}, "instruction_set.*baseline"),
    ],
)
def test_bad_options_are_named(options: dict[str, float], word: str) -> None:
    with pytest.raises(InputError, match=word):
        OTSolverNative(**options)


def test_nan_and_half_precision_are_refused() -> None:
    good = cloud(8, seed=1)
    broken = good.clone()
    broken[3, 1] = math.nan
    with pytest.raises(InputError, match=r"target.*nan"):
        OTSolverNative().solve(good, broken)
    with pytest.raises(InputError, match=r"source.*float16"):
        OTSolverNative().solve(good.half(), good.half())


def test_missing_compiled_module_names_the_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(cpdeform_native, "_transport")
    monkeypatch.setitem(sys.modules, "cpdeform_native._transport", None)
    monkeypatch.delitem(sys.modules, "cpdeform_native.ot")
    with pytest.raises(MissingExtraError, match="pip install"):
        importlib.import_module("cpdeform_native.ot")


@pytest.mark.parametrize(("blur", "scale"), [(1e-30, 1.0), (1e-8, 1.0), (1e-3, 1e18)])
def test_a_blur_next_to_nothing_is_refused_instead_of_solved_for_ever(blur: float, scale: float) -> None:
    reason = "for points that span .*expected at least" if scale > 1.0 else "expected a positive length"
    with pytest.raises(InputError, match=rf"^blur: got .*{reason}"):
        OTSolverNative(blur=blur).solve(scale * cloud(20, seed=1), scale * cloud(20, seed=2))
