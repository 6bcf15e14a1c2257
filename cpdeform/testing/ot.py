"""`check_ot_solver`: does a transport solver keep the contract of `OTSolver` and `OTResult`?"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from cpdeform.core.errors import InputError
from cpdeform.core.ot import OTSolver, weighted_median
from cpdeform.testing.ot_bench import (
    OTBench,
    cloud,
    cosine,
    lattice,
    make_bench,
    pressed,
    stroke_offset,
)
from cpdeform.testing.report import (
    Check,
    CheckItem,
    Finding,
    Report,
    Skip,
    choose,
    complaint_unless_raised,
    run_checks,
    violations,
    worst,
)


def check_shapes(bench: OTBench) -> Finding:
    """Shapes, types and devices of the result; nothing carries a graph."""
    complaints = []
    for dtype in (torch.float64, torch.float32):
        source = bench.source.to(dtype, copy=True).requires_grad_()
        result = bench.solver.solve(source, bench.target.to(dtype))
        shapes = {"value": (), "source_potential": (60,), "target_potential": (50,), "source_gradient": (60, 3)}
        for name, shape in shapes.items():
            tensor: Tensor = getattr(result, name)
            if tuple(tensor.shape) != shape or tensor.dtype != dtype:
                complaints.append(f"{name} is {tensor.dtype} {tuple(tensor.shape)} instead of {dtype} {shape}")
            if tensor.requires_grad or not bool(torch.isfinite(tensor).all()):
                complaints.append(f"{name} carries a graph or is not finite")
        if not isinstance(result.converged, bool) or not isinstance(result.iterations, int):
            complaints.append("converged must be a bool and iterations an int")
        if not result.blur >= 0.0:
            complaints.append(f"blur is {result.blur}")
    return violations(sorted(set(complaints)))


def check_translation(bench: OTBench) -> Finding:
    """A cloud moved by 1, more than its size: the value is 1, the gradient p times the way back for each point.

    p is `OTResult.exponent`.
    """
    source = lattice(5, 0.005)
    shift = torch.tensor([0.6, 0.0, 0.8], dtype=torch.float64)
    result = bench.solver.solve(source, source + shift)
    exponent = result.exponent
    count = source.shape[0]
    expected = -exponent * shift.expand(count, 3) / count
    entropy = result.blur**exponent * math.log(count)
    figures = {
        "value": abs(float(result.value) - 1.0) / (0.01 + 2.0 * entropy),
        "gradient": float((result.source_gradient - expected).norm() / expected.norm()) / 0.1,
    }
    return worst(figures, 1.0)


def check_gauge(bench: OTBench) -> Finding:
    """The weighted median of the source potential is zero, relative to the potential's range."""
    potential = bench.result.source_potential
    median = float(weighted_median(potential, bench.source_weights))
    return Finding(abs(median) / float(potential.max() - potential.min()), 1e-6)


def check_dual_value(bench: OTBench) -> Finding:
    """The potentials' weighted sums add up to the value, relative to it."""
    result = bench.result
    dual = float((bench.source_weights * result.source_potential).sum() + result.target_potential.mean())
    return Finding(abs(dual - float(result.value)) / abs(float(result.value)), 1e-6)


def check_gradient(bench: OTBench) -> Finding:
    """Slopes of the value along random motions of the points, relative to a typical slope."""
    gradient, step = bench.result.source_gradient, 1e-4
    errors = []
    for seed in range(2):
        generator = torch.Generator().manual_seed(seed)
        direction = torch.randn(bench.source.shape, generator=generator, dtype=torch.float64)
        if seed == 1:
            direction = gradient / gradient.norm() * math.sqrt(gradient.numel())
        values = [
            float(
                bench.solver.solve(bench.source + sign * step * direction, bench.target, source_weights=bench.source_weights).value
            )
            for sign in (1.0, -1.0)
        ]
        slope = (values[0] - values[1]) / (2.0 * step)
        errors.append(abs(float((gradient * direction).sum()) - slope) / float(gradient.norm()))
    return Finding(max(errors), 0.1)


def check_potentials(bench: OTBench) -> Finding:
    """Potentials are the value's derivatives by the weights, relative to their range."""
    weights, potential = bench.source_weights, bench.result.source_potential
    generator = torch.Generator().manual_seed(5)
    direction = torch.randn(weights.shape, generator=generator, dtype=torch.float64) * weights
    direction -= weights * direction.sum()
    step = 0.02
    values = [
        float(bench.solver.solve(bench.source, bench.target, source_weights=weights + sign * step * direction).value)
        for sign in (1.0, -1.0)
    ]
    slope = (values[0] - values[1]) / (2.0 * step)
    scale = float(direction.norm()) * float((potential - potential.mean()).norm()) / math.sqrt(weights.numel())
    return Finding(abs(float((potential * direction).sum()) - slope) / scale, 0.1)


def check_weights(bench: OTBench) -> Finding:
    """A point of weight zero changes nothing; twice the weight is two points; the order does not matter."""
    source, target, solver = bench.source, bench.target, bench.solver
    plain = solver.solve(source, target)
    none = torch.cat([torch.full((60,), 1 / 60, dtype=torch.float64), torch.zeros(9, dtype=torch.float64)])
    padded = solver.solve(torch.cat([source, cloud(9, seed=3)]), target, source_weights=none)
    double = torch.ones(60, dtype=torch.float64)
    double[:20] = 2.0
    weighted = solver.solve(source, target, source_weights=double / double.sum())
    repeated = solver.solve(torch.cat([source, source[:20]]), target)
    shuffled = solver.solve(source.flip(0), target)
    size = float(plain.value)
    figures = {
        "points of weight zero": abs(float(padded.value) - size) / size,
        "their gradient": float(padded.source_gradient[60:].abs().max() / padded.source_gradient.abs().max()),
        "twice the weight": abs(float(weighted.value) - float(repeated.value)) / size,
        "order of the points": 1.0 - cosine(shuffled.source_gradient.flip(0), plain.source_gradient),
    }
    return worst(figures, 0.01)


def check_identical(bench: OTBench) -> Finding:
    """A cloud is at distance zero of itself, with zero potentials, relative to its diameter."""
    if not bench.solver.capabilities.debiased:
        raise Skip("It declares that it is not debiased.")
    source = cloud(150, seed=5)
    result = bench.solver.solve(source, source.clone())
    diameter = float(torch.cdist(source, source).max())
    figures = {
        "value": abs(float(result.value)) / diameter,
        "source potential": float(result.source_potential.abs().max()) / diameter,
        "target potential": float(result.target_potential.abs().max()) / diameter,
        "gradient of a point, in a hundredth of its weight": 0.1 * 150.0 * float(result.source_gradient.abs().max()),
    }
    if bench.solver.capabilities.potentials == "exact":
        figures = {"value": figures["value"]}
    return worst(figures, 1e-3)


def check_stroke(bench: OTBench) -> Finding:
    """Where only a pen's stroke differs, potentials are largest at the stroke and vanish far from it."""
    if bench.solver.capabilities.potentials == "exact":
        raise Skip("It declares exact potentials, which are no transport priorities: where the shapes agree they are free.")
    source = cloud(800, seed=30)
    potential = bench.solver.solve(source.float(), pressed(source).float()).source_potential.double()
    distance = stroke_offset(source).norm(dim=1)
    figures = {
        "distance of the largest potential from the stroke, in 0.03": float(distance[potential.argmax()]) / 0.03,
        "largest potential far from it, in tenths of the largest": 10.0
        * float(potential[distance > 0.08].abs().max() / potential.max()),
    }
    return worst(figures, 1.0)


def check_warm_start(bench: OTBench) -> Finding:
    """After the cloud moved a little, a warm start gives the value and gradient of a cold one."""
    if not bench.solver.capabilities.warm_start:
        bench.solver.solve(bench.source, bench.target, previous=bench.solver.solve(bench.source, bench.target))
        raise Skip("It declares no warm start; `previous` is accepted.")
    source, target = cloud(200, seed=25), cloud(200, seed=26) + 0.04
    noise = torch.randn(200, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64) * 5e-4
    start = bench.solver.solve(source, target)
    warm, cold = bench.solver.solve(source + noise, target, previous=start), bench.solver.solve(source + noise, target)
    figures = {
        "value, in 2%": abs(float(warm.value) - float(cold.value)) / float(cold.value) / 0.02,
        "cosine of the gradients, from 1, in 0.05": (1.0 - cosine(warm.source_gradient, cold.source_gradient)) / 0.05,
        "iterations, of those of a cold start": warm.iterations / max(cold.iterations, 1),
    }
    return worst(figures, 1.0)


def check_errors(bench: OTBench) -> Finding:
    """Inputs that do not fit raise `InputError` with the argument's name."""
    good = {"source": cloud(8, seed=1), "target": cloud(8, seed=2)}
    broken = good["source"].clone()
    broken[3, 1] = math.nan
    eighth = torch.full((8,), 0.125, dtype=torch.float64)
    cases: dict[str, tuple[str, Tensor]] = {
        "nan": ("source", broken),
        "points of a plane": ("source", good["source"][:, :2]),
        "no point": ("target", good["target"][:0]),
        "another type than the source's": ("target", good["target"].float()),
        "negative weights": ("source_weights", eighth * torch.tensor([-1.0, 3.0, 1, 1, 1, 1, 1, 1])),
        "weights that sum to 2": ("source_weights", 2.0 * eighth),
        "a weight too many": ("target_weights", torch.full((9,), 1.0 / 9.0, dtype=torch.float64)),
    }
    complaints = []
    for what, (name, value) in cases.items():
        arguments = {**good, name: value}
        complaints += complaint_unless_raised(
            lambda arguments=arguments: bench.solver.solve(**arguments),  # type: ignore[misc]
            InputError,
            words=[name],
            what=f"{name}: {what}",
        )
    if bench.solver.capabilities.warm_start:
        call: Callable[[], object] = lambda: bench.solver.solve(cloud(8, seed=1), good["target"], previous=bench.result)  # noqa: E731
        complaints += complaint_unless_raised(call, InputError, words=["previous"], what="previous of other sizes")
    return violations(complaints)


OT_CHECKS: tuple[CheckItem[OTBench], ...] = (
    CheckItem("shapes and types of the result", check_shapes, "Return detached tensors in the type and on the device of `source`."),
    CheckItem(
        "closed form of a translation", check_translation, "Cost is |x - y|^p in length units; check weights, scale, convergence."
    ),
    CheckItem("gauge: zero weighted median", check_gauge, "Pass the potentials through cpdeform.core.ot.fix_gauge at the end."),
    CheckItem("potentials sum to the value", check_dual_value, "Shift both potentials by one constant, the other way round."),
    CheckItem("gradient equals central differences", check_gradient, "source_gradient is d value / d source, weights included."),
    CheckItem(
        "potentials are slopes by the weights",
        check_potentials,
        "Convert scalings u to potentials eps (log u - log a); debias them.",
    ),
    CheckItem("weights and order of the points", check_weights, "Use the weights in every sum, the debiasing terms included."),
    CheckItem("identical clouds", check_identical, "Subtract the self-potentials, or declare debiased=False."),
    CheckItem(
        "priorities point at a pen's stroke",
        check_stroke,
        'Take potentials from an entropic solve, never from the exact dual; otherwise declare potentials="exact".',
    ),
    CheckItem("warm start", check_warm_start, "Refuse nothing of the same sizes; or declare warm_start=False."),
    CheckItem("bad arguments are named", check_errors, "Call cpdeform.core.ot.check_problem first in solve."),
)


def check_ot_solver(solver: OTSolver | Callable[[], OTSolver], *, only: Sequence[str] = ()) -> Report:
    """Check a transport solver: closed forms, gauge, derivatives, weights, priorities, warm start and errors.

    Args:
        solver: A solver, or what makes one without arguments, e.g. its class.
        only: Run only the checks of these names, or whose names contain these texts.

    Returns:
        What was found; `Report.raise_if_failed` turns failures into an error.

    Raises:
        InputError: No check has a name that `only` asks for.
    """
    items = choose(OT_CHECKS, only)
    name = type(solver).__name__ if isinstance(solver, OTSolver) else str(getattr(solver, "__name__", type(solver).__name__))
    try:
        made = solver if isinstance(solver, OTSolver) else solver()
        if not isinstance(made, OTSolver):
            raise TypeError(f"it is a {type(made).__name__}, not a cpdeform.core.ot.OTSolver")
        name, bench = type(made).__name__, make_bench(made)
    except Exception as error:
        advice = f"Building it and solving a problem of 60 x 50 points raised {type(error).__name__}: {error}"
        return Report(name, (Check("it solves", "failed", advice=advice),))
    return run_checks(name, items, bench)
