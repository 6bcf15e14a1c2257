"""How good a result is: every figure that results are compared by, computed the same way for every method.

The Wasserstein-1 distance comes in three kinds, between all particles, with uniform weights. ``converged`` is the debiased
Sinkhorn divergence at blur 1e-3, iterated to convergence: the metric of this package. ``paper`` is what the paper reports:
GeomLoss's default schedule, which is not converged and gives less (78-86% at blur 1e-3). ``exact`` is the unregularised
distance. A random sample of the goal's shape is not at distance zero from it; `sampling_floor` says how far away it is.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import time
from collections.abc import Callable
from typing import Any, Literal

import torch
from torch import Tensor

from cpdeform.core.errors import MissingExtraError
from cpdeform.core.ot import OTSolver
from cpdeform.core.plugins import AUTO, Registry, load_registry
from cpdeform.core.sampling import sample_particles
from cpdeform.core.task import Task
from cpdeform.planning.metrics import EVEN_SPREAD, goal_mass_grid, metric_solver, wasserstein
from cpdeform.planning.objectives.mass import mass_grid
from cpdeform.planning.objectives.metrics import incremental_iou, soft_iou
from cpdeform.run.record_reader import RunRecord

PAPER_BLUR = {"single": 1e-3, "multiple": 1e-5}
"""Blur of the paper's figures, length units, for tasks of a single stage and for those of several."""

MAX_EMD_PAIRS = 2 * 10**8
"""Pairs up to which the exact distance is computed by `ot.emd2`, which needs 43 bytes for each."""

NEARLY_EXACT_BLUR = 1e-4
"""Blur of the Sinkhorn divergence that stands for the exact distance where `ot.emd2` cannot compute it, length units."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Evaluation:
    """Figures of a result: distances in length units (the domain's edge is 1), less is better; IoU without unit, more is better.

    Attributes:
        task: Name of the task.
        particle_count: Particles N of the body.
        goal_count: Particles M of the goal.
        iou_start: Soft IoU of the start's node masses with the goal's.
        iou_final: That of the end.
        iou_goal: That of the goal with itself, the most that can be reached.
        incremental_iou: Normalised incremental IoU, the part of the way from `iou_start` to `iou_goal`, in [0, 1].
        grid: Where the goal's node masses come from: its ``"file"``, or its ``"particles"``.
        wasserstein_start: Wasserstein-1 distance of the start from the goal, ``converged``.
        wasserstein_final: That of the end.
        wasserstein_blur: Entropic blur of both, length units.
        converged: Whether both solutions met the solver's criterion.
        solver: Class of the transport solver.
        sampling_floor: ``converged`` distance of a random sample of the goal's shape from the goal; 0 where the goal's particles
            are those of the body.
        corresponds: Whether they are: particle i of the goal is particle i of the body, moved.
        paper_start: ``paper`` distance of the start; None where it was not asked for.
        paper_final: That of the end.
        paper_floor: As `sampling_floor`, by the ``paper`` distance.
        paper_blur: Entropic blur of both, length units.
        exact_start: ``exact`` distance of the start; None where it was not asked for.
        exact_final: That of the end.
        exact_method: How it was computed.
        seconds: Wall time of the parts ``iou``, ``wasserstein``, ``floor``, ``paper``, ``exact``.
    """

    task: str
    particle_count: int
    goal_count: int
    iou_start: float
    iou_final: float
    iou_goal: float
    incremental_iou: float
    grid: Literal["file", "particles"]
    wasserstein_start: float
    wasserstein_final: float
    wasserstein_blur: float
    converged: bool
    solver: str
    sampling_floor: float
    corresponds: bool
    paper_start: float | None = None
    paper_final: float | None = None
    paper_floor: float | None = None
    paper_blur: float | None = None
    exact_start: float | None = None
    exact_final: float | None = None
    exact_method: str | None = None
    seconds: dict[str, float] = dataclasses.field(default_factory=dict)


def evaluate(
    task: Task,
    *,
    start: Tensor,
    final: Tensor,
    goal: Tensor,
    solver: OTSolver | str = AUTO,
    paper: bool = False,
    paper_blur: float | None = None,
    exact: bool = False,
    registry: Registry | None = None,
) -> Evaluation:
    """Compute all figures of a result.

    Args:
        task: Gives the scene, and the goal's node masses if its file has them.
        start: Particles (N, 3) of the scene's start, length units.
        final: Particles (N, 3) at the end.
        goal: Goal particles (M, 3).
        solver: The transport solver of ``converged``, as `metric_solver` makes it, or its registered name.
        paper: Whether to compute the ``paper`` distance, too (about two minutes for 10,000 particles).
        paper_blur: Its blur; defaults to 1e-3, or 1e-5 for a task of several stages, as in the paper.
        exact: Whether to compute the ``exact`` distance, too (a minute and more, and 4.3 GB, for 10,000 particles).
        registry: Where names are looked up; defaults to the installed plugins.

    Raises:
        InputError: Positions do not fit the task.
        MissingExtraError: `paper` needs GeomLoss, which is not installed.
    """
    registry = registry or load_registry()
    start, final, goal = (positions.detach().cpu().double() for positions in (start, final, goal))
    used = metric_solver(solver=solver, registry=registry) if isinstance(solver, str) else solver
    seconds: dict[str, float] = {}
    began = time.perf_counter()
    figures = _iou_figures(task, start, final, goal)
    began = _lap(seconds, "iou", began)
    results = [wasserstein(positions, goal, solver=used) for positions in (start, final)]
    began = _lap(seconds, "wasserstein", began)
    corresponds = task.goal_corresponds()
    floor = 0.0 if corresponds else sampling_floor(goal, distance=lambda *clouds: float(wasserstein(*clouds, solver=used).value))
    began = _lap(seconds, "floor", began)
    if paper:
        figures["paper_blur"] = paper_blur or PAPER_BLUR["multiple" if task.stage_count > 1 else "single"]
        measure = functools.partial(paper_wasserstein, blur=figures["paper_blur"], registry=registry)
        figures["paper_start"], figures["paper_final"] = (measure(cloud, goal) for cloud in (start, final))
        figures["paper_floor"] = 0.0 if corresponds else sampling_floor(goal, distance=measure)
        began = _lap(seconds, "paper", began)
    if exact:
        (figures["exact_start"], _), (figures["exact_final"], figures["exact_method"]) = (
            exact_wasserstein(cloud, goal, registry=registry) for cloud in (start, final)
        )
        _lap(seconds, "exact", began)
    return Evaluation(
        task=task.name,
        particle_count=len(final),
        goal_count=len(goal),
        wasserstein_start=float(results[0].value),
        wasserstein_final=float(results[1].value),
        wasserstein_blur=results[1].blur,
        converged=results[0].converged and results[1].converged,
        solver=type(used).__name__,
        sampling_floor=floor,
        corresponds=corresponds,
        seconds=seconds,
        **figures,
    )


def evaluate_record(record: RunRecord, **options: Any) -> Evaluation:
    """Compute all figures of a recorded run: its last complete stage against the scene's start and the record's own goal.

    Args:
        record: The run.
        options: As for `evaluate`, e.g. ``paper=True``.

    Raises:
        InputError: No stage of the run is complete.
    """
    start = torch.as_tensor(sample_particles(record.task.scene))
    return evaluate(record.task, start=start, final=record.state.position[0], goal=record.goal, **options)


def sampling_floor(goal: Tensor, *, distance: Callable[[Tensor, Tensor], float], seed: int = 0) -> float:
    """Expected Wasserstein-1 distance of a random sample of a shape, of as many particles as the goal has, from the goal.

    Estimated from the goal alone. Where it is a random sample itself, by the distance between two random halves of it, which
    falls with the number of particles like N^(-1/3) [1]_, scaled from N/2 to N. Halves of an even sample are farther apart than a
    random sample is from the goal (1.4 times on the goals of `star`, `airplane`, `bottle` and `chair`). There it is the distance
    of particles drawn from the goal with replacement, each displaced within a cube as wide as the mean distance between nearest
    neighbours (0.91 to 0.99 times what random samples of these four solids have).

    Several bodies that do not touch share out their particles at random in both, which a plan does not: it is too high for them.

    Args:
        goal: Goal particles (M, 3), length units.
        distance: Distance between two clouds (M, 3), (M', 3).
        seed: Seed of the sample.

    Returns:
        The distance, length units; nan for a single particle.

    References:
        .. [1] Fournier & Guillin, "On the rate of convergence in Wasserstein distance of the empirical measure", Probability
           Theory and Related Fields, 2015.
    """
    count = len(goal)
    if count < 2:
        return float("nan")
    generator = torch.Generator().manual_seed(seed)
    gaps = _neighbour_distances(goal)
    if float(gaps.std()) < EVEN_SPREAD * float(gaps.mean()):
        drawn = goal[torch.randint(count, (count,), generator=generator)]
        offset = torch.rand(drawn.shape, generator=generator, dtype=goal.dtype) - 0.5
        return distance(drawn + float(gaps.mean()) * offset.to(goal), goal)
    half = count // 2
    order = torch.randperm(count, generator=generator)
    return distance(goal[order[:half]], goal[order[half : 2 * half]]) * math.pow(2.0, -1.0 / 3.0)


def _neighbour_distances(points: Tensor) -> Tensor:
    """Distance (N,) of each point (N, 3) to the nearest other one."""
    from scipy.spatial import cKDTree

    cloud = points.detach().cpu().numpy()
    return torch.as_tensor(cKDTree(cloud).query(cloud, k=2)[0][:, 1])


def paper_wasserstein(first: Tensor, second: Tensor, *, blur: float, registry: Registry | None = None) -> float:
    """The paper's figure: GeomLoss's `SamplesLoss("sinkhorn", p=1)` with its default schedule, debiased.

    Args:
        first: Positions (N, 3), length units.
        second: Positions (M, 3).
        blur: Entropic blur, length units.
        registry: Where GeomLoss is looked up; defaults to the installed plugins.

    Raises:
        MissingExtraError: GeomLoss is not installed.
    """
    solver: OTSolver = (registry or load_registry()).create("ot_solver", "geomloss", settings="paper", blur=blur)
    return float(solver.solve(first.detach().cpu().double(), second.detach().cpu().double()).value)


def exact_wasserstein(first: Tensor, second: Tensor, *, registry: Registry | None = None) -> tuple[float, str]:
    """The unregularised Wasserstein-1 distance, by the network simplex of POT.

    Without POT, or above `MAX_EMD_PAIRS`, it is the debiased Sinkhorn divergence at blur 1e-4, which is 0.1% less on the boards
    of the writer task.

    Args:
        first: Positions (N, 3), length units.
        second: Positions (M, 3).
        registry: Where solvers are looked up; defaults to the installed plugins.

    Returns:
        The distance in length units, and how it was computed.
    """
    registry = registry or load_registry()
    if len(first) * len(second) <= MAX_EMD_PAIRS:
        try:
            registry.load("ot_solver", "pot")
        except MissingExtraError:
            pass
        else:
            return _network_simplex(first, second), "ot.emd2"
    solver = metric_solver(blur=NEARLY_EXACT_BLUR, registry=registry)
    return float(wasserstein(first, second, solver=solver).value), f"{type(solver).__name__} at blur {NEARLY_EXACT_BLUR:g}"


def _network_simplex(first: Tensor, second: Tensor) -> float:
    import ot

    points = [cloud.detach().cpu().double() for cloud in (first, second)]
    cost = torch.cdist(points[0], points[1], compute_mode="donot_use_mm_for_euclid_dist").numpy()
    return float(ot.emd2([], [], cost, numItermax=100_000_000))


def _iou_figures(task: Task, start: Tensor, final: Tensor, goal: Tensor) -> dict[str, Any]:
    goal_grid = goal_mass_grid(task, goal)
    first, last = (mass_grid(positions, task.scene) for positions in (start, final))
    return {
        "iou_start": float(soft_iou(first, goal_grid)),
        "iou_final": float(soft_iou(last, goal_grid)),
        "iou_goal": float(soft_iou(goal_grid, goal_grid)),
        "incremental_iou": float(incremental_iou(last, start=first, goal=goal_grid)),
        "grid": "particles" if task.load_goal_grid() is None else "file",
    }


def _lap(seconds: dict[str, float], name: str, began: float) -> float:
    """Note the time of a part and return the present."""
    now = time.perf_counter()
    seconds[name] = now - began
    return now
