"""The native transport solver: warm starts, threads and instruction sets."""

from __future__ import annotations

import dataclasses
import io
import threading

import pytest
import torch
from torch import Tensor

from cpdeform.core.errors import InputError
from cpdeform.core.ot import OTResult
from cpdeform.ot.divergence import Potentials, Problem
from cpdeform.testing.ot_bench import cloud, cosine, pressed
from cpdeform_native import _transport
from cpdeform_native.ot import OrderedPotentials, OTSolverNative

STEP = 1e-3
"""RMS motion of the points between two calls, length units."""


def dented(points: Tensor) -> Tensor:
    """Points (N, 3) of the board with a broad dent of half its height in the middle, bulging aside."""
    middle = torch.tensor([0.5, 0.0, 0.5], dtype=points.dtype)
    aside = (points - middle) * torch.tensor([1.0, 0.0, 1.0], dtype=points.dtype)
    depth = torch.exp(-(aside.norm(dim=1) / 0.08).square())[:, None]
    return points + depth * (0.4 * aside - torch.tensor([0.0, 0.5, 0.0], dtype=points.dtype) * points)


def moved(points: Tensor, direction: Tensor) -> Tensor:
    return points + direction * (STEP / direction.square().sum(dim=1).mean().sqrt())


def directions(kind: str, points: Tensor, result: OTResult, generator: torch.Generator) -> Tensor:
    if kind == "descent":
        return -result.source_gradient
    if kind == "noise":
        return torch.randn(points.shape, generator=generator, dtype=points.dtype)
    waves = torch.zeros_like(points)  # smooth random motion: the transport changes over long distances
    for _ in range(6):
        wave, phase, way = (torch.randn(size, generator=generator, dtype=points.dtype) for size in (3, 1, 3))
        waves += torch.sin(points @ wave * 15.0 + 3.0 * phase)[:, None] * way
    return waves


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["descent", "noise", "smooth"])
@pytest.mark.parametrize("blur", [1e-3, 4e-3])
def test_fifty_warm_steps_stay_with_the_converged_gradient(kind: str, blur: float) -> None:
    source = cloud(2000, seed=1).float()
    target = dented(source)
    solver = OTSolverNative(blur=blur)
    converged = OTSolverNative(blur=blur, warm_iterations=3000, warm_tolerance=1e-4)
    warm = reference = solver.solve(source, target)
    generator = torch.Generator().manual_seed(3)
    cosines = []
    for _ in range(50):
        source = moved(source, directions(kind, source, reference, generator))
        reference = converged.solve(source, target, previous=reference)
        warm = solver.solve(source, target, previous=warm)
        cosines.append(cosine(warm.source_gradient, reference.source_gradient))
    assert reference.marginal_error < 2e-4
    cold = solver.solve(source, target)
    assert cosine(cold.source_gradient, reference.source_gradient) > 0.999  # the reference is what it says
    assert min(cosines) > 0.98


def test_warm_call_is_close_to_a_cold_one_and_cheaper() -> None:
    source, target = cloud(400, seed=25).float(), cloud(400, seed=26).float() + 0.02
    noise = torch.randn(400, 3, generator=torch.Generator().manual_seed(1)) * (STEP / 3**0.5)
    solver = OTSolverNative(blur=1e-3)
    start = solver.solve(source, target)
    warm, cold = solver.solve(source + noise, target, previous=start), solver.solve(source + noise, target)
    assert float(warm.value) == pytest.approx(float(cold.value), rel=1e-3)
    assert cosine(warm.source_gradient, cold.source_gradient) > 0.999
    assert warm.iterations < cold.iterations


def test_points_that_moved_too_far_are_solved_cold() -> None:
    """A rod that was carried away and turned: few iterations from the old potentials do not reach the new ones."""
    rod = (cloud(1500, seed=25).float() - 0.5) * torch.tensor([0.1, 0.1, 1.2])
    source, target = rod + torch.tensor([0.5, 0.1, 0.5]), rod.flip(0) + torch.tensor([0.6, 0.25, 0.6])
    turn = torch.tensor([[0.96, 0.0, 0.28], [0.0, 1.0, 0.0], [-0.28, 0.0, 0.96]])
    carried = rod @ turn + torch.tensor([0.6, 0.25, 0.6])
    solver = OTSolverNative(blur=2e-3, warm_iterations=2)
    start, cold = solver.solve(source, target), solver.solve(carried, target)
    warm = solver.solve(carried, target, previous=start)
    assert (float(warm.value), warm.iterations) == (float(cold.value), cold.iterations)
    assert solver.solve(source + 1e-4, target, previous=start).iterations <= 2


@pytest.mark.parametrize("debias", [True, False])
def test_warm_call_on_the_same_clouds_changes_little(debias: bool) -> None:
    source, target = cloud(400, seed=25), cloud(300, seed=26) + 0.02
    solver = OTSolverNative(blur=2e-3, debias=debias)
    start = solver.solve(source, target)
    warm = solver.solve(source, target, previous=start)
    assert warm.iterations == 1
    assert float(warm.value) == pytest.approx(float(start.value), rel=1e-4)
    assert cosine(warm.source_gradient, start.source_gradient) > 0.99999


def test_target_may_change_between_warm_calls() -> None:
    source, target = cloud(300, seed=27), cloud(300, seed=28) + 0.02
    noise = torch.randn(300, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64) * 3e-4
    solver = OTSolverNative(blur=2e-3)
    warm = solver.solve(source, target + noise, previous=solver.solve(source, target))
    cold = solver.solve(source, target + noise)
    assert float(warm.value) == pytest.approx(float(cold.value), rel=1e-3)
    assert cosine(warm.source_gradient, cold.source_gradient) > 0.999


def test_a_start_from_far_away_still_converges() -> None:
    """Potentials of another problem altogether: guesses are off by a hundred temperatures, and every block finds out."""
    solver = OTSolverNative(blur=2e-3, warm_iterations=3000, warm_tolerance=1e-6)
    other = solver.solve(cloud(300, seed=1), cloud(300, seed=2) * 3.0)
    source, target = cloud(300, seed=3), cloud(300, seed=4) + 0.02
    warm, cold = solver.solve(source, target, previous=other), solver.solve(source, target)
    assert warm.converged
    assert float(warm.value) == pytest.approx(float(cold.value), rel=1e-4)
    assert cosine(warm.source_gradient, cold.source_gradient) > 0.9999


def test_another_blur_starts_cold_and_other_sizes_are_refused() -> None:
    source, target = cloud(60, seed=1), cloud(50, seed=2)
    coarse = OTSolverNative(blur=1e-2).solve(source, target)
    fine = OTSolverNative(blur=2e-3)
    assert torch.equal(fine.solve(source, target, previous=coarse).source_gradient, fine.solve(source, target).source_gradient)
    with pytest.raises(InputError, match="previous"):
        fine.solve(source[:-1], target, previous=coarse)


# Orders and lists ---------------------------------------------------------------------------------------------------------


def state_of(result: OTResult) -> OrderedPotentials:
    assert isinstance(result.warm_state, OrderedPotentials)
    return result.warm_state


def orders_of(result: OTResult) -> tuple[Tensor, Tensor]:
    state = state_of(result)
    assert state.source_order is not None
    assert state.target_order is not None
    return state.source_order.numbers, state.target_order.numbers


def without_orders(result: OTResult) -> OTResult:
    """The same result with a state that knows the potentials alone."""
    state = state_of(result)
    fields = {field.name: getattr(state, field.name) for field in dataclasses.fields(Potentials)}
    return dataclasses.replace(result, warm_state=Potentials(**fields))


def scattered(points: Tensor, distance: float) -> Tensor:
    """Points (N, 3) moved at random by `distance` in the root mean square, length units."""
    noise = torch.randn(points.shape, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    return points + (noise * (distance / 3**0.5)).to(points)


def same_to_tolerance(first: OTResult, second: OTResult) -> bool:
    near = float(first.value) == pytest.approx(float(second.value), rel=1e-3)
    return bool(near) and cosine(first.source_gradient, second.source_gradient) > 0.9995


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_kept_order_gives_what_a_fresh_one_gives(dtype: torch.dtype) -> None:
    source, target = cloud(1500, seed=25).to(dtype), (cloud(1100, seed=26) + 0.02).to(dtype)
    solver = OTSolverNative(blur=2e-3)
    start = solver.solve(source, target)
    source = scattered(source, STEP)
    kept, fresh = solver.solve(source, target, previous=start), solver.solve(source, target, previous=without_orders(start))
    assert all(torch.equal(first, second) for first, second in zip(orders_of(start), orders_of(kept), strict=True))
    assert not torch.equal(orders_of(fresh)[0], orders_of(start)[0])
    assert torch.equal(orders_of(fresh)[0].sort().values, torch.arange(1500, dtype=torch.int32))
    assert kept.iterations == fresh.iterations
    assert same_to_tolerance(kept, fresh)


def test_points_that_move_far_are_sorted_again() -> None:
    source, target = cloud(1500, seed=25).float(), cloud(1100, seed=26).float() + 0.02
    solver = OTSolverNative(blur=5e-3, warm_iterations=3000, warm_tolerance=1e-5)
    start = solver.solve(source, target)
    before = [numbers.clone() for numbers in orders_of(start)]
    shuffled = source.roll(700, dims=0)
    warm, fresh = solver.solve(shuffled, target, previous=start), solver.solve(shuffled, target, previous=without_orders(start))
    assert torch.equal(orders_of(warm)[0], orders_of(fresh)[0])
    assert torch.equal(orders_of(warm)[1], before[1])
    assert all(torch.equal(first, second) for first, second in zip(orders_of(start), before, strict=True))
    cold = solver.solve(shuffled, target)
    assert same_to_tolerance(warm, fresh)
    assert same_to_tolerance(warm, cold)


def test_an_order_wears_out_step_by_step() -> None:
    """Every step is small, yet the blocks must not grow without end."""
    source, target = cloud(1000, seed=25).float(), cloud(1000, seed=26).float() + 0.02
    solver = OTSolverNative(blur=5e-3)
    result = start = solver.solve(source, target)
    generator = torch.Generator().manual_seed(3)
    for _ in range(12):
        source = source + torch.randn(source.shape, generator=generator) * 3e-3
        result = solver.solve(source, target, previous=result)
    assert not torch.equal(orders_of(result)[0], orders_of(start)[0])
    assert torch.equal(orders_of(result)[1], orders_of(start)[1])
    assert cosine(result.source_gradient, solver.solve(source, target).source_gradient) > 0.98


@pytest.mark.parametrize("distance", [STEP, 10 * STEP, 100 * STEP])
@pytest.mark.parametrize("blur", [1e-3, 5e-3])
def test_warm_soft_minima_are_those_of_all_pairs(distance: float, blur: float) -> None:
    """However far the points moved, no list hides a pair that matters: the source potential against all pairs."""
    source, target = cloud(900, seed=4), cloud(700, seed=5)
    solver = OTSolverNative(blur=blur, debias=False)
    source, start = scattered(source, distance), solver.solve(source, target)
    state = state_of(solver.solve(source, target, previous=start))
    problem = Problem.of(source, target, None, None, blur, 1)
    updated = problem.source_update(state.target)
    assert float((updated - state.source).abs().max()) < 0.05 * problem.epsilon


def test_a_saved_state_serves_as_well() -> None:
    source, target = cloud(300, seed=25).float(), cloud(300, seed=26).float() + 0.02
    solver = OTSolverNative(blur=2e-3)
    start = solver.solve(source, target)
    file = io.BytesIO()
    torch.save(start, file)
    file.seek(0)
    loaded = torch.load(file, weights_only=False)
    source = scattered(source, STEP)
    first, second = solver.solve(source, target, previous=start), solver.solve(source, target, previous=loaded)
    assert torch.equal(first.source_gradient, second.source_gradient)
    assert torch.equal(solver.solve(source, target, previous=None).value, solver.solve(source, target).value)


def test_an_order_with_strange_numbers_is_refused() -> None:
    source, target = cloud(60, seed=25), cloud(50, seed=26)
    solver = OTSolverNative(blur=5e-3)
    start = solver.solve(source, target)
    orders_of(start)[0][7] = 60
    with pytest.raises(ValueError, match="order"):
        solver.solve(source, target, previous=start)


# Threads and instruction sets ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_threads_change_no_digit(dtype: torch.dtype) -> None:
    source = cloud(2100, seed=30).to(dtype)
    target = pressed(source).to(dtype)
    results = [OTSolverNative(blur=3e-3, tolerance=1e-2, threads=threads).solve(source, target) for threads in (1, 2, 5)]
    for other in results[1:]:
        assert torch.equal(results[0].value, other.value)
        assert torch.equal(results[0].source_potential, other.source_potential)
        assert torch.equal(results[0].source_gradient, other.source_gradient)


@pytest.mark.parametrize("name", _transport.instruction_sets())
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("exponent", [1, 2])
def test_instruction_sets_agree(name: str, dtype: torch.dtype, exponent: int) -> None:
    source, target = cloud(333, seed=31).to(dtype), (cloud(222, seed=32) + 0.02).to(dtype)
    blur = 3e-3 if exponent == 1 else 4e-2
    first, second = (
        OTSolverNative(blur=blur, exponent=exponent, instruction_set=which).solve(source, target) for which in (name, "baseline")
    )
    assert OTSolverNative(instruction_set=name).instruction_set == name
    digits = 1e-4 if dtype == torch.float32 else 1e-8
    assert float(first.value) == pytest.approx(float(second.value), rel=digits)
    spread = float(second.source_potential.max() - second.source_potential.min())
    assert float((first.source_potential - second.source_potential).abs().max()) < digits * spread
    assert float((first.source_gradient - second.source_gradient).norm() / second.source_gradient.norm()) < 10 * digits


def test_one_solver_on_several_python_threads() -> None:
    solver = OTSolverNative(blur=5e-3, threads=2)
    problems = [(cloud(200, seed=seed), cloud(150, seed=seed + 50)) for seed in range(4)]
    expected = [solver.solve(*problem).value for problem in problems]
    found: dict[int, Tensor] = {}
    workers = [
        threading.Thread(target=lambda n=n: found.__setitem__(n, solver.solve(*problems[n]).value))  # type: ignore[misc]
        for n in range(4)
    ]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    assert all(torch.equal(found[n], expected[n]) for n in range(4))
