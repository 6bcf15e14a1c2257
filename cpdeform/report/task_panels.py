"""Start and goal of a task side by side, small: for sheets of many tasks and for cards."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cpdeform.core.sampling import sample_particles
from cpdeform.core.state import tool_pose
from cpdeform.core.task import Task
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


def draw_task(task: Task, path: Path, *, panel: float = 3.6) -> None:
    """Draw start and goal side by side into a PNG file.

    Args:
        task: The task.
        path: The file.
        panel: Width of a panel, inches of 100 pixels.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(2.0 * panel, panel / PANEL_ASPECT + 0.16), dpi=100, facecolor="white")
    canvas = FigureCanvasAgg(figure)
    axes = figure.subplots(1, 2)
    figure.subplots_adjust(left=0.005, right=0.995, bottom=0.005, top=0.92, wspace=0.02)
    draw_start_and_goal(axes[0], axes[1], task, width=int(110 * panel))
    save_picture(canvas, path)


def draw_start_and_goal(first: Any, second: Any, task: Task, *, width: int) -> None:
    """Draw a task's start with its tools into one matplotlib axis, and its goal into another.

    Args:
        first: The axis of the start.
        second: That of the goal.
        task: The task.
        width: Width of each, pixels.
    """
    start, goal = sample_particles(task.scene), task.load_goal()
    pose = tool_pose(task.scene).numpy()
    tools = [tool_surface(tool, pose[index]) for index, tool in enumerate(task.scene.tools)]
    # A fixed pillar may reach far below the floor; that part is not worth the room.
    tools = [np.maximum(surface, (-np.inf, task.scene.ground_height, -np.inf)) for surface in tools]
    view = _make_view(task, start, goal, tools)
    draw_scene(first, view, start, clay_colours(view, start), tools, width=width)
    first.set_title(f"{task.name}: start", fontsize=7, pad=1.5)
    view = dataclasses.replace(view, spacing=particle_spacing(goal))
    draw_scene(second, view, goal, clay_colours(view, goal), [], width=width)
    second.set_title("goal", fontsize=7, pad=1.5)


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


def save_picture(canvas: Any, path: Path) -> None:
    """Write a PNG file of 256 colours, dithered: half of the size, and no difference to see.

    Args:
        canvas: A matplotlib canvas.
        path: The file.
    """
    from PIL import Image

    canvas.draw()
    picture = Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3].copy())
    palette = picture.quantize(256, kmeans=1)
    picture.quantize(palette=palette, dither=Image.Dither.FLOYDSTEINBERG).save(path, format="PNG", optimize=True)
