"""Table, figure and values of the landscape study."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cpdeform.experiments.studies.figures import new_figure
from cpdeform.experiments.studies.landscape import Start
from cpdeform.experiments.studies.statistics import mean, rank_correlation
from cpdeform.experiments.studies.summary import Summary, write_summary
from cpdeform.experiments.tables import markdown

TITLE = "Losses that descent reaches from every start, beside transport priorities"
TOP_SHARE = 0.1
"""Part of the starts with the largest priorities whose losses stand beside those of all."""


def write_landscape(starts: Sequence[Start], out: Path, *, task: str, planned: int, made_by: str) -> None:
    """Write the summary of the starts that are done; its figure once all of them are.

    Args:
        starts: The starts.
        out: Where.
        task: Name of the task.
        planned: Number of starts asked for.
        made_by: Command, machine and versions, in Markdown.
    """
    correlation = rank_correlation([start.priority for start in starts], [start.loss_ratio for start in starts])
    known = [start for start in starts if math.isfinite(start.loss_ratio)]
    top = sorted(known, key=lambda start: -start.priority)[: max(1, round(TOP_SHARE * len(known)))]
    best = min(known, key=lambda start: start.loss_ratio, default=None)
    chosen = max(known, key=lambda start: start.priority, default=None)
    lines = [
        ["starts", f"{len(known)} of {planned} with a finite loss"],
        ["rank correlation of priority and loss (Spearman)", correlation.text(".3f")],
        ["mean loss / loss of doing nothing, all starts", mean([start.loss_ratio for start in known]).text(".3f")],
        [f"the same, the {TOP_SHARE:.0%} of largest priority", mean([start.loss_ratio for start in top]).text(".3f")],
        ["at the start of largest priority", "-" if chosen is None else f"{chosen.loss_ratio:.3f}"],
        ["at the best start", "-" if best is None else f"{best.loss_ratio:.3f}"],
    ]
    note = (
        "A correlation below zero says that descent gets farther where the priority is larger. Intervals are 95% bootstrap "
        "intervals over starts; neighbouring starts are not independent, so that they are too narrow. The paper shows its "
        "landscape as a figure, without numbers."
    )
    values = [dataclasses.asdict(start) for start in starts]
    summary = Summary(
        values, [markdown([f"`{task}`", ""], lines), note, made_by], (lambda: _draw(starts)) if len(starts) == planned else None
    )
    write_summary(summary, out, title=TITLE)


def _draw(starts: Sequence[Start]) -> Any:
    figure, axes = new_figure(1, 3, width=4.0, height=3.4)
    shown = {"priority": "transport priority", "loss_ratio": "best loss / loss of doing nothing"}
    for axis, (field, title) in zip(axes, shown.items(), strict=False):
        grid = _grid(starts, field)
        x, z = [start.x for start in starts], [start.z for start in starts]
        picture = axis.imshow(grid, origin="lower", extent=(min(x), max(x), min(z), max(z)), cmap="viridis", aspect="equal")
        figure.colorbar(picture, ax=axis, shrink=0.8)
        axis.set_title(title, fontsize=9)
        axis.set_xlabel("x")
        axis.set_ylabel("z")
    axes[2].scatter([start.priority for start in starts], [start.loss_ratio for start in starts], s=6.0, color="#1b6ca8")
    axes[2].set_xlabel("transport priority (length)")
    axes[2].set_ylabel("best loss / loss of doing nothing")
    return figure


def _grid(starts: Sequence[Start], field: str) -> np.ndarray:
    """Values (rows, columns) of the starts, nan where there is none."""
    rows, columns = max(start.row for start in starts) + 1, max(start.column for start in starts) + 1
    grid = np.full((rows, columns), np.nan)
    for start in starts:
        grid[start.row, start.column] = getattr(start, field)
    return grid
