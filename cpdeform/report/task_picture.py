"""A picture of a task: start with tools and goal, from two sides."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cpdeform.core.errors import InputError
from cpdeform.core.sampling import sample_particles
from cpdeform.core.state import tool_pose
from cpdeform.core.task import Task
from cpdeform.report.pictures import View, clay_colours, draw_scene
from cpdeform.report.render import fit_camera
from cpdeform.report.shapes import tool_surface
from cpdeform.report.surface import particle_spacing

Array = NDArray[np.float64]

DIRECTIONS = ((28.0, 32.0), (28.0, 78.0))
"""Azimuth and elevation of the two rows, degrees."""

ASPECT = 1.3


def draw_task(task: Task, path: Path) -> Path:
    """Draw a task.

    Args:
        task: The task.
        path: The PNG file.

    Returns:
        The file.

    Raises:
        InputError: The file cannot be written, or the goal's file not be read.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    start, goal = sample_particles(task.scene), task.load_goal()
    pose = tool_pose(task.scene).numpy()
    tools = [tool_surface(tool, pose[index]) for index, tool in enumerate(task.scene.tools)]
    figure = Figure(figsize=(10.0, 8.0), dpi=100, facecolor="white")
    canvas = FigureCanvasAgg(figure)
    axes = figure.subplots(2, 2)
    figure.subplots_adjust(left=0.01, right=0.99, bottom=0.01, top=0.93, wspace=0.02, hspace=0.04)
    for row, direction in enumerate(DIRECTIONS):
        view = _view(start, goal, tools, direction, ground=task.scene.ground_height)
        _draw(axes[row, 0], view, start, tools)
        _draw(axes[row, 1], view, goal, [])
    axes[0, 0].set_title(f"start, {len(start)} particles", fontsize=11)
    axes[0, 1].set_title(f"goal, {len(goal)} particles", fontsize=11)
    figure.suptitle(task.name, fontsize=13)
    try:
        canvas.print_figure(path, format="png")
    except OSError as error:
        came = f"a path that cannot be written ({error.strerror or error})"
        raise InputError("--out", came=came, expected="a writable path") from error
    return path


def _draw(axis: Any, view: View, particles: Array, tools: list[Array]) -> None:
    view = dataclasses.replace(view, spacing=particle_spacing(particles))
    draw_scene(axis, view, particles, clay_colours(view, particles), tools, width=480)


def _view(start: Array, goal: Array, tools: list[Array], direction: tuple[float, float], *, ground: float) -> View:
    clay = np.concatenate([start, goal])
    low, high = clay.min(axis=0), clay.max(axis=0)
    x, z = [low[0] - 0.03, high[0] + 0.03], [low[2] - 0.03, high[2] + 0.03]
    floor = np.array([[x[i], ground, z[j]] for i, j in ((0, 0), (1, 0), (1, 1), (0, 1), (0, 0))])
    everything = np.concatenate([clay, floor, *(surface.reshape(-1, 3)[::50] for surface in tools)])
    camera = fit_camera(everything, azimuth=direction[0], elevation=direction[1], aspect=ASPECT)
    return View(camera, 0.01, float(low[1]), float(high[1]), floor)
