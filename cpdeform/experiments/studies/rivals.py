"""The rivals study: all methods at equal cost, in gradient evaluations and in seconds, and the shapes they come to."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from cpdeform.experiments.experiment import family
from cpdeform.experiments.experiment_plan import REFERENCE
from cpdeform.experiments.experiment_tables import paper_figures
from cpdeform.experiments.shape_figures import SHAPE_NOTE
from cpdeform.experiments.studies.figures import colour, new_figure
from cpdeform.experiments.studies.runs import StudyRun, chosen, methods_of, tasks_of
from cpdeform.experiments.studies.search import final_distance
from cpdeform.experiments.studies.statistics import Interval, as_number, mean
from cpdeform.experiments.studies.summary import INTERVAL_NOTE, Summary
from cpdeform.experiments.studies.trace import stage_points
from cpdeform.experiments.tables import cell, markdown

OWN = (REFERENCE, "sculpt")
"""Methods of this project, which are no rivals of each other."""


def summarize(runs: Sequence[StudyRun], shares: Mapping[str, float]) -> Summary:
    """W1 of every method on every task, the differences from the reference, and the losses within the reference's seconds.

    Args:
        runs: The runs.
        shares: What a rollout costs in each task, in gradient evaluations.
    """
    tasks, methods = tasks_of(runs), methods_of(runs)
    values = [_values(runs, task, method, shares.get(task, math.nan)) for task in tasks for method in methods]
    found = {(line["task"], line["method"]): line for line in values}
    return Summary(
        values,
        [
            "## At equal cost, in gradient evaluations",
            _table(runs, tasks, methods, found),
            _verdict(runs, tasks, methods, found),
            *_shapes(tasks, methods, found),
            "## Within the same seconds",
            _seconds_table(tasks, methods, found),
            _notes(shares),
        ],
        lambda: _draw(tasks, methods, found),
    )


def _values(runs: Sequence[StudyRun], task: str, method: str, share: float) -> dict[str, Any]:
    own = [run for run in chosen(runs, task, method) if run.row.over]
    final = final_distance(runs, task, method)
    difference = _difference(runs, task, method, REFERENCE)
    ratio = mean([_ratio_within(run, _seconds(other)) for run, other in _pairs(runs, task, method, REFERENCE)])
    line: dict[str, Any] = {"task": task, "method": method, "seeds": final.count, "rollout_share": share}
    shape = mean([as_number(run.row.normalised_shape_iou) for run in own])
    intervals = {"w1_final": final, "normalised_shape_iou": shape, "w1_minus_reference": difference, "loss_ratio_in_seconds": ratio}
    intervals["cost"] = mean([_cost(run, share) for run in own])
    intervals["seconds"] = mean([_seconds(run) for run in own])
    for name, interval in intervals.items():
        line |= {name: interval.value, f"{name}_low": interval.low, f"{name}_high": interval.high}
    return line


def _final(run: StudyRun) -> float:
    return as_number(run.row.w1_final)


def _cost(run: StudyRun, share: float) -> float:
    points = stage_points(run.record) if run.record is not None else []
    return points[-1].cost(share) if points else math.nan


def _seconds(run: StudyRun) -> float:
    points = stage_points(run.record) if run.record is not None else []
    return points[-1].seconds if points else math.nan


def _ratio_within(run: StudyRun, seconds: float) -> float:
    """Loss over that at the start after the last stage that ended within the time; 1 where none did."""
    points = stage_points(run.record) if run.record is not None else []
    return min((point.ratio for point in points if point.seconds <= seconds), default=math.nan)


def _interval(line: Mapping[str, Any], name: str) -> Interval:
    return Interval(line[name], line[f"{name}_low"], line[f"{name}_high"], line["seeds"])


def _table(
    runs: Sequence[StudyRun], tasks: Sequence[str], methods: Sequence[str], found: Mapping[tuple[str, str], Mapping[str, Any]]
) -> str:
    paper = paper_figures("multi-stage")
    lines = []
    for task in tasks:
        first = mean([as_number(run.row.w1_initial) for run in runs if run.row.task == task])
        cells = []
        for method in methods:
            line = found[task, method]
            cost = "" if math.isnan(line["cost"]) else f" ({line['cost']:.0f})"
            cells.append(_interval(line, "w1_final").text(".4f") + cost)
        lines.append([task, cell(first.value, ".4f"), *cells, cell(paper.tasks.get(family(task)), ".4f")])
    return markdown(["task", "initial", *methods, "CPDeform in the paper"], lines)


def _verdict(
    runs: Sequence[StudyRun], tasks: Sequence[str], methods: Sequence[str], found: Mapping[tuple[str, str], Mapping[str, Any]]
) -> str:
    """On which tasks each of the own methods is ahead of the rivals, and by how much the best of these is behind."""
    rivals = [method for method in methods if method not in OWN]
    return "\n\n".join(_verdict_of(own, rivals, runs, tasks, found) for own in OWN if own in methods)


def _verdict_of(
    own: str,
    rivals: Sequence[str],
    runs: Sequence[StudyRun],
    tasks: Sequence[str],
    found: Mapping[tuple[str, str], Mapping[str, Any]],
) -> str:
    lines, first, clear = [], 0, 0
    for task in tasks:
        known = [method for method in rivals if math.isfinite(found[task, method]["w1_final"])]
        if not known or not math.isfinite(found[task, own]["w1_final"]):
            lines.append([task, "-", "-", "-"])
            continue
        best = min(known, key=lambda method: found[task, method]["w1_final"])
        ahead = found[task, own]["w1_final"] < found[task, best]["w1_final"]
        difference = _difference(runs, task, best, own)
        first += ahead
        clear += ahead and difference.excludes_zero()
        lines.append([task, "yes" if ahead else "no", best, difference.text(".4f")])
    table = markdown(["task", f"{own} first", "best of the rivals", f"its W1 minus that of {own}, same seeds"], lines)
    ahead_on = f"`{own}` is ahead of all rivals on {first} of {len(tasks)} tasks"
    return f"{ahead_on}, on {clear} of them with an interval without zero.\n\n{table}"


def _difference(runs: Sequence[StudyRun], task: str, method: str, other: str) -> Interval:
    """W1 of a method minus that of another one, in the mean of the seeds that both have."""
    return mean([_final(run) - _final(same) for run, same in _pairs(runs, task, method, other)])


def _pairs(runs: Sequence[StudyRun], task: str, method: str, other: str) -> list[tuple[StudyRun, StudyRun]]:
    """Runs of two methods that are over, with the same seeds."""
    found = {run.row.seed: run for run in chosen(runs, task, other) if run.row.over}
    return [(run, found[run.row.seed]) for run in chosen(runs, task, method) if run.row.over and run.row.seed in found]


def _shapes(tasks: Sequence[str], methods: Sequence[str], found: Mapping[tuple[str, str], Mapping[str, Any]]) -> Iterator[str]:
    """The normalised shape IoUs; nothing where they were not asked for."""
    lines = [
        [task, *(_interval(found[task, method], "normalised_shape_iou").text(".2f") for method in methods)]
        for task in tasks
        if any(math.isfinite(found[task, method]["normalised_shape_iou"]) for method in methods)
    ]
    if lines:
        yield "## The shapes of the same runs"
        yield markdown(["task", *methods], lines)
        yield f"Normalised shape IoU; higher is better. {SHAPE_NOTE}"


def _seconds_table(tasks: Sequence[str], methods: Sequence[str], found: Mapping[tuple[str, str], Mapping[str, Any]]) -> str:
    lines = []
    for task in tasks:
        cells = []
        for method in methods:
            line = found[task, method]
            spent = "" if math.isnan(line["seconds"]) else f" ({line['seconds']:.0f} s)"
            cells.append(_interval(line, "loss_ratio_in_seconds").text(".3f") + spent)
        lines.append([task, *cells])
    return markdown(["task", *methods], lines)


def _notes(shares: Mapping[str, float]) -> str:
    known = ", ".join(f"{task} {share:.3f}" for task, share in shares.items())
    return (
        f"{INTERVAL_NOTE}\n\n"
        "First table: W1 at the end, and in parentheses what the runs spent, in gradient evaluations; a rollout without gradient "
        f"counts its measured share of one ({known or 'not known'}). Every method may spend as much a stage as `{REFERENCE}` did "
        "in the same task with the same seed (its searches are sized for that); a run ends at the first stage that finds no plan, "
        "so that it may spend less.\n\n"
        f"Second table: loss over the loss at the start after the last stage that ended within the wall time of `{REFERENCE}` in "
        "the same task with the same seed; in parentheses the seconds of the whole run. All runs have the same cores. The loss of "
        "`sculpt` is another one, which also counts misplaced mass, and is measured from rest."
    )


def _draw(tasks: Sequence[str], methods: Sequence[str], found: Mapping[tuple[str, str], Mapping[str, Any]]) -> Any:
    """Differences of W1 from the reference, with their intervals: to the right of zero the reference is ahead."""
    others = [method for method in methods if method != REFERENCE]
    columns = min(4, max(len(tasks), 1))
    figure, axes = new_figure(-(-len(tasks) // columns), columns, width=3.2, height=0.9 + 0.28 * len(others))
    for axis, task in zip(axes, tasks, strict=False):
        for number, method in enumerate(others):
            interval = _interval(found[task, method], "w1_minus_reference")
            if math.isfinite(interval.value):
                axis.plot(interval.value, number, marker="o", color=colour(number + 1))
            if interval.known:
                axis.plot([interval.low, interval.high], [number, number], color=colour(number + 1), linewidth=2.0)
        axis.axvline(0.0, color="#999999", linewidth=0.8)
        axis.set_yticks(range(len(others)), others, fontsize=7)
        axis.invert_yaxis()
        axis.tick_params(axis="x", labelsize=7)
        axis.locator_params(axis="x", nbins=4)
        axis.ticklabel_format(axis="x", style="sci", scilimits=(-2, 2))
        axis.set_title(task, fontsize=9)
        axis.set_xlabel(f"W1 minus that of {REFERENCE}", fontsize=7)
    for axis in axes[len(tasks) :]:
        axis.set_axis_off()
    return figure
