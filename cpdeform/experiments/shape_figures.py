"""The shape figures of a row of an experiment's table."""

from __future__ import annotations

import dataclasses
from typing import Any

from cpdeform.run.record_reader import RunRecord

SHAPE_FIGURES = (
    "shape_iou_start",
    "shape_iou_final",
    "shape_iou_ceiling",
    "normalised_shape_iou",
    "silhouette_iou_x",
    "silhouette_iou_y",
    "silhouette_iou_z",
    "loose_share",
    "distance_95_result_to_goal",
    "distance_95_goal_to_result",
)
"""Fields of a row that `shape_figures` gives."""

SHAPE_NOTE = (
    "Shape IoU: cells of the grid that are full in result and goal, over those that are full in either; silhouette IoU: "
    "the same of the outlines along an axis (y: from above); start, result and goal at rest, tools away. The ceiling is "
    "what a random sample of the goal's own shape has; normalised: (final - start) / (ceiling - start). Loose share: "
    "particles in cells that are not full, beyond those of such a sample. 95% distance: 95th percentile of the distance "
    "between the surfaces, from the result to the goal and back. Goals in the air, of tasks that carry clay, lose their "
    "height when they come to rest."
)


def shape_figures(record: RunRecord) -> dict[str, Any]:
    """The figures `SHAPE_FIGURES` of a record, from rest to rest; None for one that is not known.

    Raises:
        InputError: No stage of the run is complete.
        PluginError: No simulator is installed for clay to rest in.
    """
    from cpdeform.run.shape_evaluation import evaluate_shape_record

    figures = dataclasses.asdict(evaluate_shape_record(record).figures)
    figures |= {f"silhouette_iou_{axis}": value for axis, value in zip("xyz", figures.pop("silhouette_iou"), strict=True)}
    return {name: figures[name] for name in SHAPE_FIGURES}
