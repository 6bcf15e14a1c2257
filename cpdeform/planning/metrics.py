"""The metrics that tasks are judged by: the same for every method, whatever a run's own solver and settings are."""

from __future__ import annotations

import dataclasses
import warnings

import torch
from torch import Tensor

from cpdeform.core.errors import PluginError
from cpdeform.core.ot import OTResult, OTSolver
from cpdeform.core.plugins import AUTO, Registry, load_registry
from cpdeform.core.task import Task
from cpdeform.planning.objectives.mass import mass_grid
from cpdeform.planning.objectives.metrics import incremental_iou

METRIC_BLUR = 1e-3
"""Entropic blur of the Wasserstein metric, length units; the paper's for a single stage."""

EVEN_SPREAD = 0.25
"""Standard deviation of the distances between nearest neighbours, over their mean, below which a goal counts as sampled evenly.

At random it is 0.36 in the bulk; 0.06 to 0.14 for the goals that `cpdeform.tasks` makes and imports, 0.24 for a Sobol sequence."""


@dataclasses.dataclass(frozen=True)
class MetricValues:
    """The task's metric before and after a run.

    Attributes:
        initial: Of the scene's start.
        final: At the end.
    """

    initial: float
    final: float


def evaluate_metric(task: Task, *, start: Tensor, final: Tensor, goal: Tensor, registry: Registry | None = None) -> MetricValues:
    """Values of the task's metric.

    Args:
        task: Names the metric.
        start: Particles (N, 3) of the scene's start, length units.
        final: Particles (N, 3) at the end.
        goal: Goal particles (M, 3).
        registry: Where the transport solver is looked up; defaults to the installed plugins.

    Returns:
        Normalised incremental IoU in [0, 1] (more is better; the start has 0), or the Wasserstein distance of `wasserstein` in
        length units (less is better; nan, with a warning, where no transport solver is installed).
    """
    if task.metric == "incremental_iou":
        first, last, wanted = (positions.detach().cpu().double() for positions in (start, final, goal))
        goal_grid = goal_mass_grid(task, wanted)
        start_grid = mass_grid(first, task.scene)
        values = [incremental_iou(grid, start=start_grid, goal=goal_grid) for grid in (start_grid, mass_grid(last, task.scene))]
        return MetricValues(float(values[0]), float(values[1]))
    try:
        solver = metric_solver(registry=registry)
    except PluginError as error:
        warnings.warn(f"The metric is not known: {error}", stacklevel=2)
        return MetricValues(float("nan"), float("nan"))
    initial = float(wasserstein(start, goal, solver=solver).value)
    unmoved = start.shape == final.shape and torch.equal(start.detach().cpu(), final.detach().cpu())
    return MetricValues(initial, initial if unmoved else float(wasserstein(final, goal, solver=solver).value))


def metric_solver(*, solver: str = AUTO, blur: float = METRIC_BLUR, registry: Registry | None = None) -> OTSolver:
    """The transport solver of the metric.

    Args:
        solver: A registered name; ``"auto"`` is the fastest that is installed for the CPU.
        blur: Entropic blur, length units.
        registry: Where the name is looked up; defaults to the installed plugins.

    Raises:
        UnknownNameError: There is no such solver.
        PluginError: No solver is installed.
    """
    registry = registry or load_registry()
    name = registry.resolve("ot_solver", solver, device="cpu")
    made: OTSolver = registry.create("ot_solver", name, blur=blur)
    return made


def wasserstein(first: Tensor, second: Tensor, *, solver: OTSolver) -> OTResult:
    """Wasserstein-1 distance between all particles of two clouds, uniform weights: the debiased, converged Sinkhorn divergence.

    It is computed on the CPU in single precision, so that it does not depend on where the particles came from.

    Args:
        first: Positions (N, 3), length units.
        second: Positions (M, 3).
        solver: As `metric_solver` makes it.

    Returns:
        The solution; its `value` is the distance in length units.
    """
    clouds = (points.detach().to(device="cpu", dtype=torch.float32).contiguous() for points in (first, second))
    return solver.solve(*clouds)


def goal_mass_grid(task: Task, goal: Tensor) -> Tensor:
    """Node masses (G, G, G) of the goal: those in its own file where it has them, else its particles'.

    Args:
        task: Its file may hold node masses.
        goal: Goal particles (M, 3), length units.
    """
    grid = task.load_goal_grid()
    return mass_grid(goal, task.scene) if grid is None else torch.as_tensor(grid).to(goal)
