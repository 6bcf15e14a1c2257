"""How the loss of a recorded run fell: stage by stage, and evaluation by evaluation."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

from cpdeform.planning.optimizer import SEARCH
from cpdeform.run.record_reader import RunRecord


@dataclasses.dataclass(frozen=True)
class StagePoint:
    """The end of a stage.

    Attributes:
        stage: Its number.
        seconds: Wall time since the run began.
        gradient_evaluations: Since the run began.
        rollouts: Rollouts without a gradient since the run began.
        loss: Loss of what was executed so far, objective units.
        ratio: That over the loss at the run's start.
    """

    stage: int
    seconds: float
    gradient_evaluations: int
    rollouts: int
    loss: float
    ratio: float

    def cost(self, share: float) -> float:
        """What was spent, in gradient evaluations; a rollout counts as a `share` of one."""
        return self.gradient_evaluations + share * self.rollouts


def stage_points(record: RunRecord) -> list[StagePoint]:
    """A point for the start and for the end of each complete stage."""
    if not record.stages:
        return []
    first = record.stages[0].loss_before
    points = [StagePoint(-1, 0.0, 0, 0, first, 1.0)]
    for stage in record.stages:
        last = points[-1]
        points.append(
            StagePoint(
                stage=stage.index,
                seconds=last.seconds + float(stage.seconds["total"]),
                gradient_evaluations=last.gradient_evaluations + stage.gradient_evaluations,
                rollouts=last.rollouts + stage.rollouts,
                loss=stage.loss,
                ratio=stage.loss / first,
            )
        )
    return points


def learning_curve(record: RunRecord) -> list[tuple[int, float]]:
    """Gradient evaluations since the run began, and the best loss so far over the loss at its start, after each iteration.

    Within a stage the best candidate counts; refinements, whose loss is another one, do not.
    """
    points = stage_points(record)
    if not points:
        return []
    first, executed = points[0].loss, {point.stage: point.loss for point in points}
    curve, evaluations, best = [(0, 1.0)], 0, first
    for line in record.metrics:
        if line.get("kind") == "stage":
            best = min(best, executed.get(int(line["stage"]), math.inf))
            curve.append((evaluations, best / first))
        elif line.get("kind") == "iteration":
            evaluations += _computed(line)
            if line.get("phase") == SEARCH:
                best = min([best, *_numbers(line["best_loss"])])
                curve.append((evaluations, best / first))
    return curve


def value_at(curve: list[tuple[int, float]], evaluations: float) -> float:
    """The best loss of a curve after so many evaluations at most; nan before its first point."""
    return min((loss for count, loss in curve if count <= evaluations), default=math.nan)


def _computed(line: Mapping[str, Any]) -> int:
    """Worlds whose loss an iteration computed."""
    return len(_numbers(line["loss"]))


def _numbers(values: list[float | None]) -> list[float]:
    return [value for value in values if value is not None]
