"""The table of figures on a run's page: how good start and result are, and how good they could be."""

from __future__ import annotations

from typing import Any

from cpdeform.run.evaluation import Evaluation
from cpdeform.run.shape_evaluation import ShapeEvaluation

Row = dict[str, Any]


def figure_rows(evaluation: Evaluation, shape: ShapeEvaluation | None) -> list[Row]:
    """Rows of the table, as `cpdeform evaluate` gives them.

    Args:
        evaluation: Distances and IoU.
        shape: Shape figures; None where they were not computed.

    Returns:
        Rows with ``name``, ``start``, ``result``, ``bound`` (the best that can be reached), ``better`` ("higher" or "lower") and
        ``note``; a number that is not known is None.
    """
    wasserstein = (evaluation.wasserstein_start, evaluation.wasserstein_final, evaluation.sampling_floor)
    iou = (evaluation.iou_start, evaluation.iou_final, evaluation.iou_goal)
    rows = [
        _row("Wasserstein-1 distance", *wasserstein, "lower", f"domain edges; bound: {_floor(evaluation)}"),
        _row("soft IoU", *iou, "higher", f"node masses; bound: the goal with itself, from its {evaluation.grid}"),
        _row("incremental IoU", 0.0, evaluation.incremental_iou, 1.0, "higher", "the part of the way from start to bound"),
    ]
    if shape is None:
        return rows
    figures = shape.figures
    rest = "as it is" if shape.simulator is None else f"at rest ({shape.simulator})"
    shapes = (figures.shape_iou_start, figures.shape_iou_final, figures.shape_iou_ceiling)
    silhouettes = zip("xyz", figures.silhouette_iou, strict=True)
    return [
        *rows,
        _row("shape IoU", *shapes, "higher", f"volume, {rest}; bound: a sample of the goal"),
        *(_row(f"silhouette IoU along {axis}", None, value, 1.0, "higher", rest) for axis, value in silhouettes),
        _row("loose share of clay", None, figures.loose_share, 0.0, "lower", "beyond that of a sample of the goal"),
        _row("95% distance, result to goal", None, figures.distance_95_result_to_goal, 0.0, "lower", "cells"),
        _row("95% distance, goal to result", None, figures.distance_95_goal_to_result, 0.0, "lower", "cells"),
    ]


def recorded_rows(run: dict[str, Any]) -> list[Row]:
    """The one row that a record has without an evaluation: the task's own metric."""
    if run.get("metric_value") is None:
        return []
    name, better = str(run["metric"]), "lower" if run["metric"] == "wasserstein" else "higher"
    numbers = (run.get("metric_initial"), run["metric_value"], 0.0 if better == "lower" else 1.0)
    return [_row(name.replace("_", " "), *numbers, better, "the task's metric")]


def _row(name: str, start: float | None, result: float, bound: float, better: str, note: str) -> Row:
    return {"name": name, "start": start, "result": result, "bound": bound, "better": better, "note": note}


def _floor(evaluation: Evaluation) -> str:
    return "0, the goal's particles are the body's" if evaluation.corresponds else "a random sample of the goal"
