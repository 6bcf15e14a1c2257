"""Draw start and goal of tasks onto contact sheets: `python -m cpdeform.tasks.draw_goals [--out docs/pictures]`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Annotated

import typer

from cpdeform.core.plugins import Registry, load_registry
from cpdeform.core.task import list_variants, load_task, task_path
from cpdeform.report.task_panels import PANEL_ASPECT, draw_start_and_goal, save_picture

PANEL_WIDTHS = {True: 2.2, False: 3.6}
"""Width of a panel on sheets of tasks with variants and on the others, inches of 100 pixels."""

SHEETS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "goals-multi-stage-1": ("airplane", "chair", "bottle", "star"),
        "goals-multi-stage-2": ("move++", "rope++", "writer++", "pinch"),
        "goals-single-stage-1": ("move", "triple-move", "torus"),
        "goals-single-stage-2": ("rope", "rolling-pin", "writer"),
        "goals-single-stage-3": ("chopsticks", "assembly", "table"),
    }
)
"""The tasks on each contact sheet. A task with variants fills two rows, starts and goals; another one two panels."""


def main(
    out: Annotated[Path, typer.Option(help="Directory that the pictures are written to.")] = Path("docs/pictures"),
    sheet: Annotated[list[str] | None, typer.Option(help="A sheet to draw; defaults to all. May be repeated.")] = None,
) -> None:
    """Draw the contact sheets."""
    registry = load_registry()
    out.mkdir(parents=True, exist_ok=True)
    for name in sheet or SHEETS:
        path = draw_sheet(SHEETS[name], out / f"{name}.png", registry=registry)
        typer.echo(f"{path}: {path.stat().st_size // 1000} kB")


def draw_sheet(names: tuple[str, ...], path: Path, *, registry: Registry) -> Path:
    """Draw tasks onto one picture.

    Args:
        names: Tasks without variants. The first one decides: all of them have variants, or none has.
        path: The PNG file.
        registry: Where to look the tasks up.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    variants = [list_variants(task_path(name, registry=registry)) for name in names]
    if variants[0]:
        columns = [[f"{name}-{variant}" for variant in found] for name, found in zip(names, variants, strict=True)]
    else:
        columns = [list(names)]
    shape = (2 * len(columns), max(len(row) for row in columns))
    panel = PANEL_WIDTHS[bool(variants[0])]
    width, height = panel * shape[1], (panel / PANEL_ASPECT + 0.16) * shape[0]
    figure = Figure(figsize=(width, height), dpi=100, facecolor="white")
    canvas = FigureCanvasAgg(figure)
    axes = figure.subplots(*shape, squeeze=False)
    figure.subplots_adjust(left=0.005, right=0.995, bottom=0.005, top=1.0 - 0.16 / height, wspace=0.02, hspace=0.1)
    for row, tasks in enumerate(columns):
        for column, name in enumerate(tasks):
            task = load_task(name, registry=registry)
            draw_start_and_goal(axes[2 * row, column], axes[2 * row + 1, column], task, width=int(110 * panel))
    save_picture(canvas, path)
    return path


if __name__ == "__main__":
    typer.run(main)
