"""The search study: how far each way of finding contacts comes (the paper's comparison with other searches)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from cpdeform.experiments.experiment import family
from cpdeform.experiments.experiment_tables import paper_figures
from cpdeform.experiments.studies.figures import colour, new_figure
from cpdeform.experiments.studies.runs import StudyRun, chosen, methods_of, tasks_of
from cpdeform.experiments.studies.statistics import Interval, as_number, mean
from cpdeform.experiments.studies.summary import INTERVAL_NOTE, Summary
from cpdeform.experiments.tables import cell, markdown


def summarize(runs: Sequence[StudyRun]) -> Summary:
    """W1 at the end of every method on every task, beside the paper's."""
    tasks, methods = tasks_of(runs), methods_of(runs)
    paper = paper_figures("multi-stage")
    values, lines = [], []
    for task in tasks:
        own = {method: final_distance(runs, task, method) for method in methods}
        efforts = {
            method: mean([as_number(run.row.gradient_evaluations) for run in chosen(runs, task, method)]) for method in methods
        }
        first = mean([as_number(run.row.w1_initial) for run in runs if run.row.task == task])
        cells = [f"{own[method].text('.4f')}, {efforts[method].value:.0f}" for method in methods]
        lines.append([task, cell(first.value, ".4f"), *cells, cell(paper.tasks.get(family(task)), ".4f")])
        values += [_line(task, method, own[method], efforts[method]) for method in methods]
    table = markdown(["task", "initial", *methods, "CPDeform in the paper"], lines)
    source = f'Paper: {paper.source}, {paper.table}; "-": not known here. {paper.note}'
    note = f"W1 at the end, and gradient evaluations. {INTERVAL_NOTE} {source}"
    return Summary(values, [table, note], lambda: _draw(runs, tasks, methods))


def final_distance(runs: Sequence[StudyRun], task: str, method: str) -> Interval:
    """W1 at the end of the runs that came to their end."""
    return mean([as_number(run.row.w1_final) for run in chosen(runs, task, method) if run.row.over])


def _line(task: str, method: str, final: Interval, effort: Interval) -> dict[str, Any]:
    return {
        "task": task,
        "method": method,
        "seeds": final.count,
        "w1_final": final.value,
        "w1_final_low": final.low,
        "w1_final_high": final.high,
        "gradient_evaluations": effort.value,
    }


def _draw(runs: Sequence[StudyRun], tasks: Sequence[str], methods: Sequence[str]) -> Any:
    figure, (axis,) = new_figure(1, 1, width=2.0 + 1.1 * len(tasks), height=3.4)
    width = 0.8 / max(len(methods), 1)
    for number, method in enumerate(methods):
        for place, task in enumerate(tasks):
            first = mean([as_number(run.row.w1_initial) for run in runs if run.row.task == task]).value
            found = final_distance(runs, task, method)
            if not math.isfinite(found.value):
                continue
            height, at = found.value / first, place + (number - 0.5 * (len(methods) - 1)) * width
            axis.bar(at, height, 0.92 * width, color=colour(number), label=method if place == 0 else None)
            if found.known:
                error = [[height - found.low / first], [found.high / first - height]]
                axis.errorbar(at, height, yerr=error, color="#333333", capsize=2.5, linewidth=1.0)
    axis.axhline(1.0, color="#999999", linewidth=0.8, linestyle=":")
    axis.set_xticks(range(len(tasks)), tasks)
    axis.set_ylabel("W1 at the end / at the start")
    figure.legend(*axis.get_legend_handles_labels(), loc="outside upper center", ncols=5, fontsize=8, frameon=False)
    return figure
