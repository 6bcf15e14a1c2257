"""The runtime study: best loss against wall time, a point a stage."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from cpdeform.experiments.studies.figures import colour, new_figure
from cpdeform.experiments.studies.runs import StudyRun, chosen, methods_of, tasks_of
from cpdeform.experiments.studies.statistics import mean
from cpdeform.experiments.studies.summary import INTERVAL_NOTE, Summary
from cpdeform.experiments.studies.trace import StagePoint, stage_points
from cpdeform.experiments.tables import markdown


def summarize(runs: Sequence[StudyRun]) -> Summary:
    """Loss and wall time at the end of each stage."""
    tasks, methods = tasks_of(runs), methods_of(runs)
    points = {(run.row.task, run.row.method, run.row.seed): stage_points(run.record) for run in runs if run.record is not None}
    values = [
        {
            "task": task,
            "method": method,
            "seed": seed,
            "stage": point.stage,
            "seconds": point.seconds,
            "gradient_evaluations": point.gradient_evaluations,
            "rollouts": point.rollouts,
            "loss": point.loss,
            "loss_ratio": point.ratio,
        }
        for (task, method, seed), found in points.items()
        for point in found
    ]
    lines = []
    for task in tasks:
        for method in methods:
            found = [points[key] for key in points if key[:2] == (task, method) and points[key]]
            ratio = mean([stages[-1].ratio for stages in found])
            seconds = mean([stages[-1].seconds for stages in found])
            lines.append([task, method, ratio.text(".3f"), seconds.text(".1f"), _rate(found)])
    header = ["task", "method", "last loss / first loss", "seconds", "seconds a stage"]
    note = (
        f"Wall time of the stages, evaluation of the result not included, on the machine named in table.md. {INTERVAL_NOTE} "
        "The paper shows this as a figure, on another machine."
    )
    return Summary(values, [markdown(header, lines), note], lambda: _draw(runs, points, tasks, methods))


def _rate(found: Sequence[list[StagePoint]]) -> str:
    rates = [stages[-1].seconds / (len(stages) - 1) for stages in found if len(stages) > 1]
    return "-" if not rates else mean(rates).text(".1f")


def _draw(
    runs: Sequence[StudyRun], points: dict[tuple[str, str, int], list[StagePoint]], tasks: Sequence[str], methods: Sequence[str]
) -> Any:
    columns = min(4, len(tasks))
    figure, axes = new_figure(-(-len(tasks) // columns), columns, width=3.2, height=2.6)
    for axis, task in zip(axes, tasks, strict=False):
        for number, method in enumerate(methods):
            for place, run in enumerate(chosen(runs, task, method)):
                stages = points.get((task, method, run.row.seed), [])
                seconds, ratios = [point.seconds for point in stages], [point.ratio for point in stages]
                label = method if place == 0 else None
                axis.plot(seconds, ratios, marker="o", markersize=3.0, linewidth=1.0, color=colour(number), label=label)
        axis.set_title(task, fontsize=9)
        axis.set_xlabel("seconds", fontsize=8)
        axis.set_ylabel("loss / first loss", fontsize=8)
        top = axis.get_ylim()[1]
        axis.set_ylim(0.0, top if math.isfinite(top) else 1.0)
    for axis in axes[len(tasks) :]:
        axis.set_axis_off()
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=5, fontsize=8, frameon=False)
    return figure
