"""Time, accuracy and memory of one transport solver at one size; meant for a fresh process, see `cpdeform.experiments.worker`.

The problem is a board of clay against the same board with a broad dent in its middle. After a cold solution the particles move
smoothly at random, as they do when an optimiser changes a plan, and every step is solved from the one before.
"""

from __future__ import annotations

import dataclasses
import statistics
import time
from typing import Any

import torch
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from cpdeform.core.errors import CpdeformError
from cpdeform.core.memory import MemoryGauge
from cpdeform.core.ot import OTResult, OTSolver
from cpdeform.core.plugins import Registry, load_registry

REFERENCES = ("native", "pot", "geomloss")
"""Solvers that may give the converged gradient, the best first."""

REFERENCE_TOLERANCE = 1e-5
REFERENCE_POINTS = 2000  # the most that a reference other than the first is asked for
STEP = 1e-3  # RMS motion of a step, length units
MEGABYTE = 1e6


@dataclasses.dataclass(frozen=True, kw_only=True)
class OTMeasurement:
    """What to measure.

    Attributes:
        solver: Registered name of the solver.
        points: Points of each cloud.
        threads: Threads on the CPU.
        blur: Entropic blur, length units.
        device: ``"cpu"``, ``"cuda"`` or ``"cuda:N"``.
        steps: Warm calls.
        repeat: Cold solutions timed; the median counts.
        exact_points: Up to this many points the value is compared with the exact cost.
        options: Further options of the solver.
    """

    solver: str
    points: int
    threads: int = 1
    blur: float = 2e-3
    device: str = "cpu"
    steps: int = 10
    repeat: int = 1
    exact_points: int = 2000
    options: dict[str, Any] = dataclasses.field(default_factory=dict)


def measure(request: dict[str, Any]) -> dict[str, Any]:
    """Measure what a request, the fields of an `OTMeasurement`, asks for.

    Returns:
        ``cold_ms`` and ``warm_ms``, medians; ``cold_iterations``, ``converged``; ``cold_gradient_cosine`` and
        ``warm_gradient_cosine`` with the converged gradient of the same blur, the latter after all steps;
        ``reference``, the solver that gave it; ``value_error_against_exact``, relative and signed, blur included;
        ``peak_memory_mb`` (1e6 bytes) of a cold solution. What is unknown is None.

    Raises:
        CpdeformError: The solver cannot do it.
    """
    wanted = OTMeasurement(**request)
    torch.set_num_threads(wanted.threads)
    registry = load_registry()
    solver = _build(registry, wanted.solver, wanted, **wanted.options)
    source, target = (points.to(wanted.device) for points in dented_board(wanted.points))
    _solve(solver, source[:100], target[:100])  # loads what is loaded on first use
    gauge = MemoryGauge(wanted.device)
    cold, seconds = _solve(solver, source, target)
    peak = gauge.peak()
    times = [seconds, *(_solve(solver, source, target)[1] for _ in range(wanted.repeat - 1))]
    warm_times, warm, moved = [], cold, source
    if solver.capabilities.warm_start:
        generator = torch.Generator().manual_seed(1)
        for _ in range(wanted.steps):
            moved = moved + smooth_motion(source.cpu(), generator).to(source)
            warm, seconds = _solve(solver, moved, target, previous=warm)
            warm_times.append(seconds)
    name, reference = _reference(registry, wanted)
    return {
        "cold_ms": 1e3 * statistics.median(times),
        "warm_ms": 1e3 * statistics.median(warm_times) if warm_times else None,
        "cold_iterations": cold.iterations,
        "converged": cold.converged,
        "cold_gradient_cosine": _cosine(cold, reference, source, target),
        "warm_gradient_cosine": _cosine(warm, reference, moved, target) if warm_times else None,
        "reference": name,
        "value_error_against_exact": _error(cold, source, target) if wanted.points <= wanted.exact_points else None,
        "peak_memory_mb": peak / MEGABYTE,
    }


def dented_board(count: int) -> tuple[Tensor, Tensor]:
    """Random points (count, 3) of a board of 0.3 x 0.1 x 0.3 length units, and the same after a broad dent."""
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(count, 3, generator=generator) * torch.tensor([0.3, 0.1, 0.3]) + torch.tensor([0.35, 0.0, 0.35])
    aside = (points - torch.tensor([0.5, 0.0, 0.5])) * torch.tensor([1.0, 0.0, 1.0])
    depth = torch.exp(-(aside.norm(dim=1) / 0.08).square())[:, None]
    return points, points + depth * (0.4 * aside - torch.tensor([0.0, 0.5, 0.0]) * points)


def smooth_motion(points: Tensor, generator: torch.Generator) -> Tensor:
    """Displacements (N, 3) of `points` that are random sums of waves, `STEP` in the root mean square."""
    motion = torch.zeros_like(points)
    for _ in range(6):
        wave, phase, way = (torch.randn(size, generator=generator) for size in (3, 1, 3))
        motion += torch.sin(15.0 * (points @ wave) + 3.0 * phase)[:, None] * way
    return motion * (STEP / motion.square().sum(dim=1).mean().sqrt())


def _build(registry: Registry, name: str, wanted: OTMeasurement, **options: Any) -> OTSolver:
    known = registry.option_names("ot_solver", name)
    if known is not None and "threads" in known:
        options["threads"] = wanted.threads
    solver: OTSolver = registry.create("ot_solver", name, blur=wanted.blur, **options)
    return solver


def _solve(solver: OTSolver, source: Tensor, target: Tensor, previous: OTResult | None = None) -> tuple[OTResult, float]:
    """Solution, and the seconds that it took."""
    begin = time.perf_counter()
    result = solver.solve(source, target, previous=previous)
    float(result.value)  # waits for a GPU
    return result, time.perf_counter() - begin


def _reference(registry: Registry, wanted: OTMeasurement) -> tuple[str | None, OTSolver | None]:
    """A solver for converged gradients, and its name; None where there is none, or it would take too long."""
    for name in REFERENCES:
        try:
            solver = _build(registry, name, wanted, tolerance=REFERENCE_TOLERANCE)
        except CpdeformError:
            continue
        fits = name == REFERENCES[0] or wanted.points <= REFERENCE_POINTS
        return (name, solver) if fits else (None, None)
    return None, None


def _cosine(result: OTResult, reference: OTSolver | None, source: Tensor, target: Tensor) -> float | None:
    if reference is None:
        return None
    gradients = (result.source_gradient, reference.solve(source, target).source_gradient)
    first, second = (gradient.double().flatten() for gradient in gradients)
    return float(torch.nn.functional.cosine_similarity(first, second, dim=0))


def _error(result: OTResult, source: Tensor, target: Tensor) -> float:
    """Relative error of the value against the exact cost, that of the best assignment of points of equal weight."""
    cost = torch.cdist(source.double().cpu(), target.double().cpu(), compute_mode="donot_use_mm_for_euclid_dist").numpy()
    exact = float(cost[linear_sum_assignment(cost)].mean())
    return float(result.value) / exact - 1.0
