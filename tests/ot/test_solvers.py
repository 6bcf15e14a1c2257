"""The mathematics that every optimal-transport solver must satisfy, asserted for POT and GeomLoss alike."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from cpdeform.core.errors import InputError
from cpdeform.core.ot import OTResult, OTSolver, weighted_median
from cpdeform.ot.geomloss import OTSolverGeomLoss
from cpdeform.ot.plugin import cpdeform_ot_solvers
from cpdeform.ot.pot import OTSolverPOT

ot = pytest.importorskip("ot")

MakeSolver = Callable[..., OTSolver]
SOLVERS: dict[str, MakeSolver] = {"pot": OTSolverPOT, "geomloss": OTSolverGeomLoss}
pytestmark = pytest.mark.filterwarnings("error")


@pytest.fixture(params=sorted(SOLVERS))
def make(request: pytest.FixtureRequest) -> MakeSolver:
    return SOLVERS[request.param]


def cloud(count: int, seed: int, dtype: torch.dtype = torch.float64) -> Tensor:
    """Random points of a unit-density box like a task's: 0.3 x 0.1 x 0.3 around (0.5, 0.05, 0.5)."""
    generator = torch.Generator().manual_seed(seed)
    points = torch.rand(count, 3, generator=generator, dtype=torch.float64)
    return (points * torch.tensor([0.3, 0.1, 0.3]) + torch.tensor([0.35, 0.0, 0.35])).to(dtype)


def random_weights(count: int, seed: int) -> Tensor:
    weights = 0.2 + torch.rand(count, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return weights / weights.sum()


def exact_cost(source: Tensor, target: Tensor, exponent: int = 1) -> float:
    cost = (source[:, None] - target).norm(dim=2).pow(exponent).numpy()
    uniform = [torch.full((len(points),), 1 / len(points), dtype=torch.float64).numpy() for points in (source, target)]
    return float(ot.emd2(*uniform, cost))


def cosine(first: Tensor, second: Tensor) -> float:
    return float(torch.nn.functional.cosine_similarity(first.double().flatten(), second.double().flatten(), dim=0))


def value_of(result: OTResult, source_weights: Tensor, target_weights: Tensor) -> float:
    return float((source_weights * result.source_potential).sum() + (target_weights * result.target_potential).sum())


# Closed forms -------------------------------------------------------------------------------------------------------------


def test_translation_by_more_than_its_size_costs_its_length(make: MakeSolver) -> None:
    # The entropic costs exceed the exact ones by eps log N at most, so the divergence is that close to the exact cost.
    axis = torch.linspace(0, 0.02, 5, dtype=torch.float64)
    source = torch.cartesian_prod(axis, axis, axis)[:120]
    shift = torch.tensor([0.6, 0.0, 0.8], dtype=torch.float64)
    result = make(blur=4e-4).solve(source, source + shift)
    assert float(result.value) == pytest.approx(1.0, abs=4e-4 * math.log(120))
    assert result.converged
    direction = -shift.expand(120, 3) / 120
    assert torch.allclose(result.source_gradient, direction, atol=0.03 / 120)


def test_squared_cost_of_a_translation_is_its_square_and_its_gradient_constant(make: MakeSolver) -> None:
    source = cloud(150, seed=1)
    shift = torch.tensor([0.05, 0.02, -0.03], dtype=torch.float64)
    result = make(blur=1e-2, exponent=2, tolerance=1e-6).solve(source, source + shift)
    assert float(result.value) == pytest.approx(float(shift @ shift), rel=1e-3)
    assert torch.allclose(result.source_gradient, -2 * shift.expand(150, 3) / 150, atol=1e-3 / 150)


def test_two_weighted_points_ship_the_surplus(make: MakeSolver) -> None:
    # Weight 0.7 and 0.3 against 0.4 and 0.6 on the same two points: 0.3 moves over the distance 0.5.
    points = torch.tensor([[0.0, 0.0, 0.0], [0.3, 0.0, 0.4]], dtype=torch.float64)
    first, second = torch.tensor([0.7, 0.3], dtype=torch.float64), torch.tensor([0.4, 0.6], dtype=torch.float64)
    result = make(blur=1e-3).solve(points, points, source_weights=first, target_weights=second)
    assert float(result.value) == pytest.approx(0.15, rel=0.005)
    difference = float(result.source_potential[0] - result.source_potential[1])
    assert difference == pytest.approx(0.5, rel=0.005)  # the price of moving from the first to the second point


def test_points_on_a_line_are_matched_in_order(make: MakeSolver) -> None:
    generator = torch.Generator().manual_seed(2)
    source, target = torch.zeros(2, 80, 3, dtype=torch.float64)
    source[:, 0] = torch.rand(80, generator=generator, dtype=torch.float64)
    target[:, 0] = 0.4 + 0.5 * torch.rand(80, generator=generator, dtype=torch.float64)
    expected = float((source[:, 0].sort().values - target[:, 0].sort().values).abs().mean())
    assert float(make(blur=3e-4).solve(source, target).value) == pytest.approx(expected, rel=0.01)


@pytest.mark.parametrize("exponent", [1, 2])
def test_small_blur_agrees_with_the_exact_cost(make: MakeSolver, exponent: int) -> None:
    source, target = cloud(200, seed=3), cloud(200, seed=4) * torch.tensor([1.0, 1.5, 0.9])
    result = make(blur=5e-4 if exponent == 1 else 3e-3, exponent=exponent).solve(source, target)
    assert float(result.value) == pytest.approx(exact_cost(source, target, exponent), rel=0.01)


# Symmetries ---------------------------------------------------------------------------------------------------------------


def test_a_cloud_is_at_distance_zero_of_itself(make: MakeSolver) -> None:
    source = cloud(300, seed=5)
    result = make(blur=2e-3).solve(source, source.clone())
    assert abs(float(result.value)) < 1e-6
    assert float(result.source_potential.abs().max()) < 1e-4
    assert float(result.target_potential.abs().max()) < 1e-4
    assert float(result.source_gradient.abs().max()) < 1e-2 / 300
    assert bool(torch.isfinite(result.source_gradient).all())  # |x - y| has no gradient at the distance zero of every copy


def test_scaling_lengths_scales_value_and_potentials(make: MakeSolver) -> None:
    source, target = cloud(150, seed=6), cloud(150, seed=7) + 0.02
    small = make(blur=2e-3).solve(source, target)
    large = make(blur=2e-2).solve(10 * source, 10 * target)
    assert float(large.value) == pytest.approx(10 * float(small.value), rel=1e-3)
    assert cosine(large.source_gradient, small.source_gradient) > 0.999
    assert torch.allclose(large.source_potential, 10 * small.source_potential, atol=0.02 * float(large.source_potential.max()))


def test_order_of_the_points_does_not_matter(make: MakeSolver) -> None:
    source, target = cloud(150, seed=8), cloud(140, seed=9) + 0.02
    order = torch.randperm(150, generator=torch.Generator().manual_seed(0))
    straight, shuffled = make(blur=2e-3).solve(source, target), make(blur=2e-3).solve(source[order], target.flip(0))
    assert float(straight.value) == pytest.approx(float(shuffled.value), rel=1e-3)
    assert cosine(straight.source_gradient[order], shuffled.source_gradient) > 0.999


def test_twice_the_weight_is_two_points(make: MakeSolver) -> None:
    source, target = cloud(100, seed=10), cloud(100, seed=11) + 0.02
    weights = torch.ones(100, dtype=torch.float64)
    weights[:30] = 2
    weights /= weights.sum()
    doubled = torch.cat([source, source[:30]])
    solver = make(blur=3e-3, tolerance=1e-5)
    weighted, repeated = solver.solve(source, target, source_weights=weights), solver.solve(doubled, target)
    assert float(weighted.value) == pytest.approx(float(repeated.value), rel=1e-3)
    merged = repeated.source_gradient[:100].clone()
    merged[:30] += repeated.source_gradient[100:]
    assert cosine(weighted.source_gradient, merged) > 0.999


def test_points_without_weight_change_nothing(make: MakeSolver) -> None:
    source, target = cloud(100, seed=10), cloud(100, seed=11) + 0.02
    weights = torch.cat([torch.full((100,), 0.01, dtype=torch.float64), torch.zeros(20, dtype=torch.float64)])
    extended = torch.cat([source, cloud(20, seed=12)])
    plain = make(blur=3e-3).solve(source, target)
    padded = make(blur=3e-3).solve(extended, target, source_weights=weights)
    assert float(padded.value) == pytest.approx(float(plain.value), rel=1e-3)
    assert bool(torch.isfinite(padded.source_potential).all())
    assert float(padded.source_gradient[100:].abs().max()) == 0


# The contract -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("debias", [True, False])
def test_value_is_the_dual_value_and_the_gauge_holds(make: MakeSolver, debias: bool) -> None:
    source, target = cloud(150, seed=13), cloud(130, seed=14) + 0.02
    first, second = random_weights(150, seed=1), random_weights(130, seed=2)
    solver = make(blur=3e-3, debias=debias)
    result = solver.solve(source, target, source_weights=first, target_weights=second)
    assert value_of(result, first, second) == pytest.approx(float(result.value), abs=1e-12)
    assert float(weighted_median(result.source_potential, first)) == pytest.approx(0, abs=1e-12)
    assert solver.capabilities.debiased is debias
    assert solver.capabilities.potentials == "entropic"
    assert result.converged
    assert result.marginal_error <= 1e-3
    assert result.blur == 3e-3


@pytest.mark.parametrize("exponent", [1, 2])
def test_gradient_agrees_with_finite_differences(make: MakeSolver, exponent: int) -> None:
    source, target = cloud(40, seed=15), cloud(45, seed=16) + 0.03
    weights = random_weights(40, seed=3)
    solver = make(blur=1e-2 if exponent == 1 else 5e-2, exponent=exponent, tolerance=1e-9)
    gradient = solver.solve(source, target, source_weights=weights).source_gradient
    for point, axis in ((0, 0), (7, 1), (21, 2)):
        step = torch.zeros_like(source)
        step[point, axis] = 1e-5
        values = [float(solver.solve(source + sign * step, target, source_weights=weights).value) for sign in (1, -1)]
        assert float(gradient[point, axis]) == pytest.approx((values[0] - values[1]) / 2e-5, rel=1e-3, abs=1e-6)


def test_single_precision_agrees_with_double(make: MakeSolver) -> None:
    source, target = cloud(200, seed=17), cloud(200, seed=18) + 0.02
    double = make(blur=2e-3).solve(source, target)
    single = make(blur=2e-3).solve(source.float(), target.float())
    assert single.value.dtype == single.source_potential.dtype == single.source_gradient.dtype == torch.float32
    assert float(single.value) == pytest.approx(float(double.value), rel=1e-3)
    assert cosine(single.source_gradient, double.source_gradient) > 0.999


def test_results_carry_no_graph_and_leave_gradients_as_they_were(make: MakeSolver) -> None:
    source = cloud(60, seed=19).requires_grad_(True)
    with torch.no_grad():
        result = make(blur=5e-3).solve(source, cloud(60, seed=20))
        assert not torch.is_grad_enabled()
    assert not any(tensor.requires_grad for tensor in (result.value, result.source_potential, result.source_gradient))


@pytest.mark.parametrize("changed", ["stroke", "random"])
def test_pot_and_geomloss_agree(changed: str) -> None:
    source = cloud(300, seed=21)
    target = pressed(source) if changed == "stroke" else cloud(300, seed=22) * torch.tensor([1.0, 0.8, 1.0]) + 0.01
    first, second = (SOLVERS[name](blur=1e-3).solve(source, target) for name in ("pot", "geomloss"))
    assert float(first.value) == pytest.approx(float(second.value), rel=0.005)
    assert cosine(first.source_gradient, second.source_gradient) > 0.995
    tolerance = min(SOLVERS[name]().capabilities.potential_tolerance for name in SOLVERS)
    spread = float(second.source_potential.max() - second.source_potential.min())
    assert float((first.source_potential - second.source_potential).abs().max()) < tolerance * spread


@pytest.mark.parametrize("changed", ["stroke", "random"])
def test_potentials_are_those_of_the_tightly_converged_problem(make: MakeSolver, changed: str) -> None:
    source = cloud(200, seed=23)
    target = pressed(source) if changed == "stroke" else cloud(200, seed=24) + 0.02
    usual = make(blur=2e-3).solve(source, target)
    tight = make(blur=2e-3, scaling=0.8, tolerance=1e-6, iterations=10000).solve(source, target)
    spread = float(tight.source_potential.max() - tight.source_potential.min())
    difference = float((usual.source_potential - tight.source_potential).abs().max())
    assert difference < make().capabilities.potential_tolerance * spread


# Warm starts --------------------------------------------------------------------------------------------------------------


def test_warm_call_is_close_to_converged_and_cheap(make: MakeSolver) -> None:
    source, target = cloud(400, seed=25, dtype=torch.float32), cloud(400, seed=26, dtype=torch.float32) + 0.02
    noise = torch.randn(400, 3, generator=torch.Generator().manual_seed(1)) * (1e-3 / math.sqrt(3))
    solver = make(blur=1e-3)
    start = solver.solve(source, target)
    warm, cold = solver.solve(source + noise, target, previous=start), solver.solve(source + noise, target)
    assert float(warm.value) == pytest.approx(float(cold.value), rel=0.01)
    assert cosine(warm.source_gradient, cold.source_gradient) > 0.97
    assert warm.iterations == 1 < cold.iterations
    weights = torch.full((400,), 1 / 400)
    assert value_of(warm, weights, weights) == pytest.approx(float(warm.value), abs=1e-6)


def test_target_may_change_between_warm_calls(make: MakeSolver) -> None:
    source, target = cloud(300, seed=27), cloud(300, seed=28) + 0.02
    noise = torch.randn(300, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64) * 3e-4
    solver = make(blur=2e-3, warm_iterations=3)
    warm = solver.solve(source, target + noise, previous=solver.solve(source, target))
    cold = solver.solve(source, target + noise)
    assert float(warm.value) == pytest.approx(float(cold.value), rel=0.01)
    assert cosine(warm.source_gradient, cold.source_gradient) > 0.97


def test_previous_of_other_sizes_is_refused(make: MakeSolver) -> None:
    solver = make(blur=5e-3)
    previous = solver.solve(cloud(30, seed=0), cloud(30, seed=1))
    with pytest.raises(InputError, match="previous"):
        solver.solve(cloud(31, seed=0), cloud(30, seed=1), previous=previous)


# The pen stroke: why priorities are entropic potentials -------------------------------------------------------------------

STROKE = torch.tensor([[0.45, 0.1, 0.55], [0.5, 0.1, 0.6]], dtype=torch.float64)
RADIUS = 0.03


def stroke_offset(points: Tensor) -> Tensor:
    """Vectors (N, 3) from the nearest point of the stroke."""
    start, axis = STROKE[0], STROKE[1] - STROKE[0]
    along = ((points - start) @ axis / (axis @ axis)).clamp(0, 1)
    return points - start - along[:, None] * axis


def pressed(points: Tensor) -> Tensor:
    """Particles near the stroke pushed down and aside by at most 12 mm, fading to nothing; all others stay exactly."""
    offset = stroke_offset(points)
    distance = offset.norm(dim=1)
    push = 0.4 * RADIUS * (1 - distance / (1.6 * RADIUS)).clamp(min=0)
    direction = offset / distance.clamp_min(1e-9)[:, None]
    direction[:, 1] = -direction[:, 1].abs()
    return points + push[:, None] * direction


@pytest.mark.parametrize("blur", [1e-3, 5e-3])
def test_priorities_point_at_the_pen_stroke(make: MakeSolver, blur: float) -> None:
    source = cloud(1500, seed=30)
    result = make(blur=blur).solve(source.float(), pressed(source).float())
    distance = stroke_offset(source).norm(dim=1)
    peak = float(result.source_potential.max())
    assert float(distance[result.source_potential.argmax()]) < 0.02
    assert float(result.source_potential[distance > 0.08].abs().max()) < 0.05 * peak
    assert result.converged


def test_exact_dual_does_not_point_at_the_pen_stroke() -> None:
    source = cloud(1500, seed=30)
    uniform = torch.full((1500,), 1 / 1500, dtype=torch.float64)
    _, log = ot.emd(uniform.numpy(), uniform.numpy(), torch.cdist(source, pressed(source)).numpy(), log=True)
    potential = torch.as_tensor(log["u"])
    potential = potential - weighted_median(potential, uniform)
    distance = stroke_offset(source).norm(dim=1)
    assert float(potential[distance > 0.08].abs().max()) > 0.3 * float(potential.abs().max())


# Options of one solver ----------------------------------------------------------------------------------------------------


def test_exact_value_with_entropic_potentials() -> None:
    source, target = cloud(300, seed=31), pressed(cloud(300, seed=31))
    exact, entropic = OTSolverPOT(value="exact").solve(source, target), OTSolverPOT().solve(source, target)
    weights = torch.full((300,), 1 / 300, dtype=torch.float64)
    assert float(exact.value) == pytest.approx(exact_cost(source, target), rel=1e-9)
    assert value_of(exact, weights, weights) == pytest.approx(float(exact.value), abs=1e-12)
    assert torch.equal(exact.source_potential, entropic.source_potential)
    step = torch.zeros_like(source)
    moved = int((target - source).norm(dim=1).argmax())
    step[moved, 1] = 1e-6
    slope = (exact_cost(source + step, target) - exact_cost(source - step, target)) / 2e-6
    assert float(exact.source_gradient[moved, 1]) == pytest.approx(slope, abs=1e-6)


def test_logarithmic_method_of_pot_gives_the_same() -> None:
    source, target = cloud(120, seed=32), cloud(120, seed=33) + 0.02
    first, second = (
        OTSolverPOT(blur=3e-3, method=method).solve(source, target) for method in ("sinkhorn_log", "sinkhorn_stabilized")
    )
    assert float(first.value) == pytest.approx(float(second.value), rel=1e-3)
    assert cosine(first.source_gradient, second.source_gradient) > 0.999


def test_paper_settings_reproduce_geomloss() -> None:
    from geomloss import SamplesLoss

    source, target = cloud(150, seed=34, dtype=torch.float32), cloud(150, seed=35, dtype=torch.float32)
    points = source.clone().requires_grad_(True)
    value = SamplesLoss(loss="sinkhorn", p=1, blur=1e-3, backend="tensorized")(points, target)
    value.backward()
    result = OTSolverGeomLoss(settings="paper").solve(source, target)
    assert float(result.value) == pytest.approx(float(value.detach()), rel=1e-5)
    assert points.grad is not None
    assert torch.allclose(result.source_gradient, points.grad, atol=1e-7)
    assert not result.converged
    assert not math.isfinite(result.marginal_error)


# Errors -------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"source": torch.full((4, 3), math.nan)}, "source.*nan"),
        ({"source": torch.zeros(4, 2)}, "source.*shape"),
        ({"target": torch.zeros(4, 3, dtype=torch.float64)}, "target.*float64"),
        ({"source_weights": torch.tensor([0.5, 0.6, -0.1, 0.0])}, "source_weights.*negative"),
        ({"source_weights": torch.full((4,), 0.5)}, "source_weights.*sum of 2"),
        ({"target_weights": torch.full((5,), 0.2)}, "target_weights.*shape"),
    ],
)
def test_bad_arguments_are_named(make: MakeSolver, change: dict[str, Tensor], words: str) -> None:
    arguments = {"source": torch.rand(4, 3), "target": torch.rand(4, 3), **change}
    with pytest.raises(InputError, match=words):
        make(blur=1e-2).solve(**arguments)


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
    ],
)
def test_bad_options_are_named(make: MakeSolver, options: dict[str, float], word: str) -> None:
    with pytest.raises(InputError, match=word):
        make(**options)


def test_plugin_registers_both_solvers() -> None:
    specs = {spec.name: spec for spec in cpdeform_ot_solvers()}
    assert {name: spec.target for name, spec in specs.items()} == {
        "pot": "cpdeform.ot.pot:OTSolverPOT",
        "geomloss": "cpdeform.ot.geomloss:OTSolverGeomLoss",
    }


@pytest.mark.parametrize(("blur", "scale"), [(1e-30, 1.0), (1e-8, 1.0), (1e-3, 1e18)])
def test_a_blur_next_to_nothing_is_refused_instead_of_solved_for_ever(make: MakeSolver, blur: float, scale: float) -> None:
    source, target = scale * cloud(20, 1), scale * cloud(20, 2)
    # Below a millionth it is refused whatever the points, above it where they span too much.
    reason = "for points that span .*expected at least" if scale > 1.0 else "expected a positive length"
    with pytest.raises(InputError, match=rf"^blur: got .*{reason} .*Usual values"):
        make(blur=blur).solve(source, target)


def test_the_least_blur_is_solved(make: MakeSolver) -> None:
    source, target = cloud(20, 1), cloud(20, 2)
    result = make(blur=1e-6, iterations=100).solve(source, target)
    cost = torch.cdist(source, target).numpy()
    weights = [1.0 / 20] * 20
    assert float(result.value) == pytest.approx(ot.emd2(weights, weights, cost), rel=1e-3)
