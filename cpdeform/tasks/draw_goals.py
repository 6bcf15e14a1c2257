"""Draw start and goal of tasks onto contact sheets: `python -m cpdeform.tasks.draw_goals [--out docs/pictures]`."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from cpdeform.core.plugins import Registry, load_registry
from cpdeform.core.sampling import sample_particles
from cpdeform.core.state import tool_pose
from cpdeform.core.task import Task, list_variants, load_task, task_path
from cpdeform.report.pictures import View, clay_colours, draw_scene
from cpdeform.report.render import fit_camera
from cpdeform.report.shapes import tool_surface
from cpdeform.report.surface import particle_spacing

Array = NDArray[np.float64]

DIRECTION = (28.0, 42.0)
"""Azimuth and elevation, degrees, from which a task is drawn."""

DIRECTIONS: Mapping[str, tuple[float, float]] = MappingProxyType({"writer++": (6.0, 66.0)})
"""Those of tasks that show their shape from elsewhere: letters are read from above."""

PANEL_ASPECT = 1.3
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
            _draw_pair(axes[2 * row, column], axes[2 * row + 1, column], task, width=int(110 * panel))
    _save(canvas, path)
    return path


def _draw_pair(upper: Any, lower: Any, task: Task, *, width: int) -> None:
    """Draw a task's start with its tools above, its goal below, each `width` pixels wide."""
    start, goal = sample_particles(task.scene), task.load_goal()
    pose = tool_pose(task.scene).numpy()
    tools = [tool_surface(tool, pose[index], rows=220, columns=320) for index, tool in enumerate(task.scene.tools)]
    # A fixed pillar may reach far below the floor; that part is not worth the room.
    tools = [np.maximum(surface, (-np.inf, task.scene.ground_height, -np.inf)) for surface in tools]
    view = _make_view(task, start, goal, tools)
    draw_scene(upper, view, start, clay_colours(view, start), tools, width=width)
    upper.set_title(f"{task.name}: start", fontsize=7, pad=1.5)
    view = dataclasses.replace(view, spacing=particle_spacing(goal))
    draw_scene(lower, view, goal, clay_colours(view, goal), [], width=width)
    lower.set_title("goal", fontsize=7, pad=1.5)


def _make_view(task: Task, start: Array, goal: Array, tools: list[Array]) -> View:
    clay = np.concatenate([start, goal])
    low, high = clay.min(axis=0), clay.max(axis=0)
    ground = task.scene.ground_height
    x, z = (low[0] - 0.03, high[0] + 0.03), (low[2] - 0.03, high[2] + 0.03)
    floor = np.array([[x[0], ground, z[0]], [x[1], ground, z[0]], [x[1], ground, z[1]], [x[0], ground, z[1]], [x[0], ground, z[0]]])
    azimuth, elevation = DIRECTIONS.get(task.name, DIRECTION)
    everything = np.concatenate([clay, floor, *(surface.reshape(-1, 3) for surface in tools)])
    camera = fit_camera(everything, azimuth=azimuth, elevation=elevation, aspect=PANEL_ASPECT, margin=0.03)
    return View(camera, particle_spacing(start), float(low[1]), float(high[1]), floor)


def _save(canvas: Any, path: Path) -> None:
    """Write a PNG file of 256 colours: a third of the size, and no difference to see."""
    from PIL import Image

    canvas.draw()
    picture = Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3].copy())
    picture.quantize(256, dither=Image.Dither.NONE).save(path, optimize=True)


if __name__ == "__main__":
    typer.run(main)
