"""The ablation study: learning curves of discovered contacts against random ones."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from cpdeform.experiments.studies.figures import colour, new_figure
from cpdeform.experiments.studies.runs import StudyRun, chosen, methods_of, tasks_of
from cpdeform.experiments.studies.statistics import mean
from cpdeform.experiments.studies.summary import INTERVAL_NOTE, Summary
from cpdeform.experiments.studies.trace import learning_curve, value_at
from cpdeform.experiments.tables import markdown

SHARES = (0.25, 0.5, 1.0)
"""Parts of the evaluations that all runs of a task have made, at which they are compared."""

Curve = list[tuple[int, float]]


def summarize(runs: Sequence[StudyRun]) -> Summary:
    """The best loss so far over the gradient evaluations."""
    tasks, methods = tasks_of(runs), methods_of(runs)
    curves = {
        (task, method): {run.row.seed: learning_curve(run.record) for run in chosen(runs, task, method) if run.record is not None}
        for task in tasks
        for method in methods
    }
    values = [
        {"task": task, "method": method, "seed": seed, "gradient_evaluations": count, "loss_ratio": loss}
        for (task, method), found in curves.items()
        for seed, curve in found.items()
        for count, loss in curve
    ]
    lines = []
    for task in tasks:
        common = _common(curves, task)
        for method in methods:
            found = curves[task, method].values()
            at = [mean([value_at(curve, share * common) for curve in found]).text(".3f") for share in SHARES]
            lines.append([task, method, *at])
        lines[-len(methods)][0] = f"{task} ({common})"
    header = ["task (evaluations made by all)", "method", *(f"loss at {share:.0%} of these" for share in SHARES)]
    note = (
        f"Best loss so far over the loss at the start. {INTERVAL_NOTE} The paper shows these curves as a figure, without numbers."
    )
    return Summary(values, [markdown(header, lines), note], lambda: _draw(curves, tasks, methods))


def _common(curves: dict[tuple[str, str], dict[int, Curve]], task: str) -> int:
    """Evaluations that every run of a task has made."""
    lengths = [curve[-1][0] for (name, _), found in curves.items() if name == task for curve in found.values() if curve]
    return min(lengths, default=0)


def _draw(curves: dict[tuple[str, str], dict[int, Curve]], tasks: Sequence[str], methods: Sequence[str]) -> Any:
    columns = min(4, len(tasks))
    figure, axes = new_figure(-(-len(tasks) // columns), columns, width=3.2, height=2.6)
    for axis, task in zip(axes, tasks, strict=False):
        for number, method in enumerate(methods):
            found = [curve for curve in curves[task, method].values() if curve]
            if not found:
                continue
            grid = np.arange(max(curve[-1][0] for curve in found) + 1)
            at = [mean([value_at(curve, float(count)) for curve in found]) for count in grid[:: max(1, len(grid) // 60)]]
            places = grid[:: max(1, len(grid) // 60)]
            axis.step(places, [item.value for item in at], where="post", color=colour(number), label=method)
            if all(item.known for item in at):
                low, high = [item.low for item in at], [item.high for item in at]
                axis.fill_between(places, low, high, step="post", color=colour(number), alpha=0.18, linewidth=0.0)
        axis.set_title(task, fontsize=9)
        axis.set_xlabel("gradient evaluations", fontsize=8)
        axis.set_ylabel("best loss / first loss", fontsize=8)
    for axis in axes[len(tasks) :]:
        axis.set_axis_off()
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=5, fontsize=8, frameon=False)
    return figure
