"""All stages of a run on one sheet, and its learning curves."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path

from cpdeform.report.pictures import describe, draw_panel, draw_priorities, make_view
from cpdeform.report.surface import particle_spacing
from cpdeform.run.record import RunRecord
from cpdeform.run.record_files import replacing

MOST_ROWS = 24
"""Stages on a sheet; of a longer run it shows the first ones."""

CURVE_COLUMNS = 4


def draw_sheet(record: RunRecord, *, camera: str | tuple[float, float] = "default") -> Path:
    """Draw ``sheet.png`` into the record's directory: a row a stage, with priorities and placed tools, result, and goal.

    Args:
        record: The run.
        camera: Where to look from, see `cpdeform.report.pictures.direction_of`.

    Raises:
        InputError: No stage is complete.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    view = make_view(record, camera=camera)
    goal = record.goal.double()
    goal_view = dataclasses.replace(view, spacing=particle_spacing(goal.numpy()))
    stages = record.stages[:MOST_ROWS]
    figure = Figure(figsize=(10.5, 3.1 * len(stages) + 0.5), dpi=100, layout="constrained", facecolor="white")
    canvas = FigureCanvasAgg(figure)
    axes = figure.subplots(len(stages), 3, squeeze=False)
    for row, stage in zip(axes, stages, strict=True):
        placed = stage.candidates[stage.best].proposal.pose if stage.best is not None else stage.state_before.tool_pose[0]
        draw_priorities(figure, row[0], view, record, stage, placed)
        title = f"stage {stage.index + 1}: {stage.status.value.replace('_', ' ')}, loss {stage.loss_before:.4g} → {stage.loss:.4g}"
        draw_panel(row[1], view, record, title, stage.state.position[0], stage.state.tool_pose[0])
        draw_panel(row[2], goal_view, record, "goal", goal, None)
    left = len(record.stages) - len(stages)
    figure.suptitle(describe(record) + (f"; {left} further stages are not shown" if left else ""), fontsize=11)
    path = record.directory / "sheet.png"
    with replacing(path) as temporary:
        canvas.print_figure(temporary, format="png")
    return path


def draw_curves(record: RunRecord) -> Path | None:
    """Draw ``curves.png`` into the record's directory: the loss of each candidate over the iterations, a panel a stage.

    Returns:
        The picture; None where no iteration is recorded.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    lines = [line for line in record.metrics if line.get("kind") == "iteration"]
    stages = sorted({int(line["stage"]) for line in lines})
    if not stages:
        return None
    columns = min(CURVE_COLUMNS, len(stages))
    rows = math.ceil(len(stages) / columns)
    figure = Figure(figsize=(3.4 * columns, 2.5 * rows + 0.4), dpi=110, layout="constrained", facecolor="white")
    canvas = FigureCanvasAgg(figure)
    axes = figure.subplots(rows, columns, squeeze=False)
    for axis, stage in zip(axes.flat, stages, strict=False):
        own = [line for line in lines if line["stage"] == stage]
        for batch in sorted({line["batch"] for line in own}):
            losses = [[math.nan if loss is None else loss for loss in line["loss"]] for line in own if line["batch"] == batch]
            axis.plot(range(1, len(losses) + 1), losses, linewidth=1.1)
        axis.set_title(f"stage {stage + 1}", fontsize=9)
        axis.tick_params(labelsize=7)
        axis.xaxis.set_major_locator(MaxNLocator(integer=True))
        axis.set_xlabel("iteration", fontsize=7)
        axis.set_ylabel("loss", fontsize=7)
    for axis in axes.flat[len(stages) :]:
        axis.set_axis_off()
    path = record.directory / "curves.png"
    with replacing(path) as temporary:
        canvas.print_figure(temporary, format="png")
    return path
