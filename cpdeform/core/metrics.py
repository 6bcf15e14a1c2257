"""The metrics that tasks are judged by."""

from __future__ import annotations

from torch import Tensor

from cpdeform.core.objectives.metrics import incremental_iou
from cpdeform.core.objectives.plasticinelab import mass_grid
from cpdeform.core.ot import OTSolver
from cpdeform.core.task import Task


def evaluate_metric(task: Task, start: Tensor, final: Tensor, target: Tensor, ot_solver: OTSolver) -> float:
    """Value of the task's metric.

    Args:
        task: Names the metric.
        start: Particles (N, 3) before the first stage, length units.
        final: Particles (N, 3) at the end.
        target: Goal particles (M, 3).
        ot_solver: Solves for ``"wasserstein"``.

    Returns:
        Normalised incremental IoU in [0, 1] (more is better), or the Wasserstein distance in length units (less is better).
    """
    if task.metric == "wasserstein":
        return float(ot_solver.solve(final, target).value)
    grids = [mass_grid(positions, task.scene) for positions in (start, final, target)]
    return float(incremental_iou(grids[1], target=grids[2], start=grids[0]))
