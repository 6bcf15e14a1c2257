"""The picture of a run: start, priorities, result, goal; drawn from the run record alone."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cpdeform.core.errors import InputError
from cpdeform.core.wording import counted
from cpdeform.planning.result import StageResult
from cpdeform.report.render import Array, Camera, fit_camera, render
from cpdeform.report.shapes import tool_surface
from cpdeform.report.surface import particle_spacing
from cpdeform.run.record import RunRecord
from cpdeform.run.record_files import replacing

DIRECTIONS: Mapping[str, tuple[float, float]] = MappingProxyType(
    {"default": (28.0, 42.0), "front": (0.0, 8.0), "side": (90.0, 8.0), "top": (0.0, 89.0), "back": (208.0, 42.0)}
)
"""Names of directions to look from: azimuth and elevation, degrees."""

PANEL_ASPECT = 1.15
CLAY = ("#5b2c1d", "#a8603c", "#dca577", "#f8e6cc")
"""Colours of the clay from low to high."""


@dataclasses.dataclass(frozen=True)
class View:
    """What all panels and frames of a run share.

    Attributes:
        camera: From where everything is drawn.
        spacing: Edge of the cube that a particle has to itself, length units.
        low: Height at the dark end of the clay's colours, length units.
        high: Height at their light end.
        floor: Corners (5, 3) of the rectangle of floor below all shapes, closed, length units.
    """

    camera: Camera
    spacing: float
    low: float
    high: float
    floor: Array


def draw_picture(record: RunRecord, *, camera: str | tuple[float, float] = "default") -> Path:
    """Draw ``picture.png`` into the record's directory and return its path.

    Args:
        record: The run.
        camera: Where to look from, see `direction_of`.

    Raises:
        InputError: No stage is complete.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    view = make_view(record, camera=camera)
    figure = Figure(figsize=(15.0, 4.6), dpi=120, layout="constrained", facecolor="white")
    canvas = FigureCanvasAgg(figure)
    axes = figure.subplots(1, 4)
    stage, last = _shown_stage(record), record.stages[-1]
    start, result = record.stages[0].state_before, last.state
    placed = stage.candidates[stage.best].proposal.pose if stage.best is not None else stage.state_before.tool_pose[0]
    draw_panel(axes[0], view, record, "start", start.position[0], start.tool_pose[0])
    draw_priorities(figure, axes[1], view, record, stage, placed)
    title = "result" if last.status.executed or record.finished_stages else "result (no plan was executed)"
    draw_panel(axes[2], view, record, title, result.position[0], result.tool_pose[0])
    # The goal often has another number of particles than the body.
    goal_view = dataclasses.replace(view, spacing=particle_spacing(_numbers(record.goal)))
    draw_panel(axes[3], goal_view, record, "goal", record.goal, None)
    _add_height_bar(figure, axes, view)
    figure.suptitle(describe(record), fontsize=13)
    path = record.directory / "picture.png"
    with replacing(path) as temporary:
        canvas.print_figure(temporary, format="png")
    return path


def describe(record: RunRecord) -> str:
    """The title: task, loss before and after, metric."""
    last = record.stages[-1]
    text = f"{record.task.name}:  loss {record.stages[0].loss_before:.4g} → {last.loss:.4g}"
    if record.run.get("metric_value") is not None:
        text += f",  {record.run['metric'].replace('_', ' ')} {record.run['metric_value']:.4g}"
    return f"{text}  ({counted(record.finished_stages, 'stage')} executed, status {record.status.replace('_', ' ')})"


def direction_of(camera: str | tuple[float, float]) -> tuple[float, float]:
    """Azimuth and elevation, degrees, of a direction given by its name, as text ("28,42"), or as two numbers.

    Raises:
        InputError: It is none of that.
    """
    if isinstance(camera, str) and camera in DIRECTIONS:
        return DIRECTIONS[camera]
    parts = camera.split(",") if isinstance(camera, str) else camera
    try:
        azimuth, elevation = (float(part) for part in parts)
    except (TypeError, ValueError) as error:
        expected = f"{', '.join(DIRECTIONS)}, or azimuth and elevation in degrees, such as 28,42"
        raise InputError("camera", came=repr(camera), expected=expected) from error
    if not (math.isfinite(azimuth) and -90.0 <= elevation <= 90.0):
        raise InputError("camera", came=repr(camera), expected="an elevation from -90 to 90 degrees")
    return azimuth, elevation


def make_view(record: RunRecord, *, camera: str | tuple[float, float] = "default") -> View:
    """Camera, particle size and colour range that suit all shapes of a run.

    Args:
        record: The run.
        camera: Where to look from, see `direction_of`.

    Raises:
        InputError: No stage is complete, or the camera is none.
    """
    azimuth, elevation = direction_of(camera)
    if not record.stages:
        raise InputError(f"run record {record.directory}", came="no complete stage", expected="at least one to draw")
    goal = record.goal.double().numpy()
    clouds = [goal] + [_numbers(state.position[0]) for stage in record.stages for state in (stage.state_before, stage.state)]
    poses = [_numbers(state.tool_pose[0]) for stage in record.stages for state in (stage.state_before, stage.state)]
    poses += [_numbers(stage.candidates[stage.best].proposal.pose) for stage in record.stages if stage.best is not None]
    shapes = [surface.reshape(-1, 3) for pose in poses for surface in tool_surfaces(record, pose, rows=16, columns=32)]
    everything = np.concatenate(clouds + shapes)
    everything = everything[np.isfinite(everything).all(axis=1)]
    clay = np.concatenate(clouds)
    ground = record.task.scene.ground_height
    low, high = clay.min(axis=0), clay.max(axis=0)
    x, z = [low[0] - 0.03, high[0] + 0.03], [low[2] - 0.03, high[2] + 0.03]
    floor = np.array([[x[0], ground, z[0]], [x[1], ground, z[0]], [x[1], ground, z[1]], [x[0], ground, z[1]], [x[0], ground, z[0]]])
    fitted = fit_camera(np.concatenate([everything, floor]), azimuth=azimuth, elevation=elevation, aspect=PANEL_ASPECT)
    return View(fitted, particle_spacing(clouds[1]), float(low[1]), float(high[1]), floor)


def tool_surfaces(record: RunRecord, poses: Array, *, rows: int = 64, columns: int = 128) -> list[Array]:
    """Surfaces (R, C, 3) of all tools of a run at the poses (M, 8)."""
    tools = record.task.scene.tools
    return [tool_surface(tool, pose, rows=rows, columns=columns) for tool, pose in zip(tools, poses, strict=True)]


def clay_colours(view: View, positions: Array) -> Array:
    """Colours (N, 3) of particles by their height."""
    from matplotlib.colors import LinearSegmentedColormap

    height = (positions[:, 1] - view.low) / max(view.high - view.low, 1e-9)
    return np.asarray(LinearSegmentedColormap.from_list("clay", CLAY)(height)[:, :3])


def draw_scene(
    axis: Any, view: View, particles: Array, colours: Array, tools: list[Array], *, width: int, quality: int = 2
) -> None:
    """Draw particles and tools on the floor into a matplotlib axis."""
    camera = view.camera
    picture = render(camera, width=width, particles=particles, colours=colours, spacing=view.spacing, tools=tools, quality=quality)
    floor = camera.project(view.floor)
    axis.fill(floor[:, 0], floor[:, 1], facecolor="#f1f0ec", edgecolor="#b9b6ad", linewidth=0.8, zorder=0)
    half_width, half_height = camera.half_width, camera.half_height
    extent = (-half_width, half_width, -half_height, half_height)
    axis.imshow(picture, extent=extent, interpolation="antialiased", zorder=1)
    _draw_directions(axis, camera)
    axis.set_xlim(-half_width, half_width)
    axis.set_ylim(-half_height, half_height)
    axis.set_aspect("equal")
    axis.set_axis_off()


def _draw_directions(axis: Any, camera: Camera) -> None:
    """Arrows along x, y and z in the lower left corner."""
    length = 0.12 * camera.half_height
    origin = np.array([-0.84 * camera.half_width, -0.84 * camera.half_height])
    for name, direction in zip("xyz", camera.axes.T[:, :2] * length, strict=True):
        axis.annotate(
            "", xy=origin + direction, xytext=origin, arrowprops={"arrowstyle": "->", "color": "#555555", "lw": 0.9}, zorder=3
        )
        axis.text(*(origin + 1.45 * direction), name, color="#555555", fontsize=8, ha="center", va="center", zorder=3)


def draw_panel(axis: Any, view: View, record: RunRecord, title: str, position: Any, pose: Any) -> None:
    """Draw particles (N, 3), and tools at poses (M, 8) unless None, into an axis with a title."""
    particles = _numbers(position)
    tools = [] if pose is None else tool_surfaces(record, _numbers(pose))
    draw_scene(axis, view, particles, clay_colours(view, particles), tools, width=420)
    axis.set_title(title, fontsize=11)


def draw_priorities(
    figure: Any, axis: Any, view: View, record: RunRecord, stage: StageResult, pose: Any, *, bar: bool = True
) -> None:
    """Panel of the transport priorities with the tools as placed; the colour bar may be left out."""
    from matplotlib import colormaps
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    particles, priorities = _numbers(stage.state_before.position[0]), _numbers(stage.priorities)
    known = bool(np.isfinite(priorities).all())
    norm = Normalize(float(priorities.min()), float(priorities.max())) if known else Normalize(0.0, 1.0)
    mappable = ScalarMappable(norm, colormaps["viridis"])
    colours = mappable.to_rgba(priorities)[:, :3] if known else np.full((len(particles), 3), 0.7)
    draw_scene(axis, view, particles, np.asarray(colours), tool_surfaces(record, _numbers(pose)), width=420)
    where = f" of stage {stage.index + 1}" if len(record.stages) > 1 else ""
    placed = "tool placed" if stage.best is not None else "no tool placed"
    axis.set_title(f"priorities{where}, {placed}" if known else f"{placed}{where} (the placer needs no priorities)", fontsize=11)
    if known and bar:
        drawn = figure.colorbar(mappable, ax=axis, location="bottom", shrink=0.7, aspect=32, pad=0.02)
        drawn.set_label("transport priority (length)", fontsize=8)
        drawn.ax.tick_params(labelsize=7)


def _add_height_bar(figure: Any, axes: NDArray[Any], view: View) -> None:
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import LinearSegmentedColormap, Normalize

    mappable = ScalarMappable(Normalize(view.low, view.high), LinearSegmentedColormap.from_list("clay", CLAY))
    for axis in (axes[0], axes[2], axes[3]):
        bar = figure.colorbar(mappable, ax=axis, location="bottom", shrink=0.7, aspect=32, pad=0.02)
        bar.set_label("height y (length)", fontsize=8)
        bar.ax.tick_params(labelsize=7)


def _shown_stage(record: RunRecord) -> StageResult:
    """The first stage whose plan was executed, otherwise the first."""
    return next((stage for stage in record.stages if stage.best is not None), record.stages[0])


def _numbers(tensor: Any) -> Array:
    return np.asarray(tensor.detach().cpu().double().numpy())
