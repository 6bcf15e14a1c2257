"""The animation of a run: every executed step of every stage."""

from __future__ import annotations

import dataclasses
import importlib.util
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cpdeform.core.errors import InputError
from cpdeform.report.pictures import View, clay_colours, draw_scene, make_view, tool_surfaces
from cpdeform.report.surface import particle_spacing
from cpdeform.run.record import RunRecord
from cpdeform.run.record_files import replacing

STEPS_PER_SECOND = 6
HOLD_SECONDS = 1.0
"""How long the last frame stands still."""

MAX_FRAMES = 120
"""More steps than this are thinned out, so that long runs are drawn in seconds, too."""

MOST_BETWEEN = 3
"""Frames for each step at most: where there are few steps, clay and tools are drawn between them, too."""

FORMATS = ("mp4", "gif")


def draw_animation(record: RunRecord, *, camera: str | tuple[float, float] = "default", form: str | None = None) -> Path | None:
    """Draw ``animation.mp4`` or ``animation.gif``: the run beside its goal.

    Args:
        record: Is drawn into its own directory.
        camera: Where to look from, see `cpdeform.report.pictures.direction_of`.
        form: ``"mp4"`` or ``"gif"``; defaults to mp4, or gif where ffmpeg is missing.

    Returns:
        Path of the animation; None where no plan was executed.

    Raises:
        InputError: There is no such form, or no ffmpeg for it.
    """
    import imageio.v2

    form = form or ("mp4" if _has_ffmpeg() else "gif")
    if form not in FORMATS or (form == "mp4" and not _has_ffmpeg()):
        raise InputError("animation", came=form, expected="gif, or mp4 where there is ffmpeg (the package imageio-ffmpeg)")
    steps = _steps(record)
    if not steps:
        return None
    between = min(max(MAX_FRAMES // len(steps), 1), MOST_BETWEEN)
    rate = STEPS_PER_SECOND * between
    pictures = list(_draw_frames(record, make_view(record, camera=camera), _moments(steps, between)))
    pictures += [pictures[-1]] * round(HOLD_SECONDS * rate)
    path = record.directory / f"animation.{form}"
    options: dict[str, Any] = (
        {"fps": rate, "codec": "libx264", "quality": 8, "macro_block_size": 4}
        if form == "mp4"
        else {"duration": 1000.0 / rate, "loop": 0}
    )
    with replacing(path) as temporary:
        writer: Any = imageio.v2.get_writer(str(temporary), format="FFMPEG" if form == "mp4" else "GIF", mode="I", **options)
        with writer:
            for picture in pictures:
                writer.append_data(picture)
    return path


def _steps(record: RunRecord) -> list[tuple[int, int]]:
    """Stage and step of all executed steps, or of evenly spread ones where there are too many."""
    steps = [
        (number, step)
        for number, stage in enumerate(record.stages)
        if stage.positions is not None
        for step in range(len(stage.positions))
    ]
    count = min(len(steps), MAX_FRAMES)
    return [steps[index] for index in np.linspace(0, len(steps) - 1, count).round().astype(int)] if steps else []


def _moments(steps: list[tuple[int, int]], between: int) -> list[tuple[int, float]]:
    """Stage and time of each frame: `between` of them for each step that another one of its stage follows."""
    moments: list[tuple[int, float]] = []
    for place, (number, step) in enumerate(steps):
        follows = place + 1 < len(steps) and steps[place + 1][0] == number
        moments += [(number, step + part / between) for part in range(between if follows else 1)]
    return moments


def _draw_frames(record: RunRecord, view: View, moments: list[tuple[int, float]]) -> Iterator[NDArray[np.uint8]]:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.6, 5.4), dpi=100, facecolor="white")
    canvas: Any = FigureCanvasAgg(figure)
    run, goal = figure.add_axes((0.0, 0.0, 0.66, 0.92)), figure.add_axes((0.66, 0.2, 0.34, 0.6))
    wanted = record.goal.double().numpy()
    goal_view = dataclasses.replace(view, spacing=particle_spacing(wanted))
    draw_scene(goal, goal_view, wanted, clay_colours(view, wanted), [], width=320)
    goal.set_title("goal", fontsize=11)
    title = figure.text(0.5, 0.96, "", ha="center", va="center", fontsize=12)
    for number, time in moments:
        stage = record.stages[number]
        if stage.positions is None or stage.tool_poses is None:
            continue
        run.clear()
        particles = _between(stage.positions.double().numpy(), time)
        poses = _between(stage.tool_poses.double().numpy(), time)
        poses[:, 3:7] /= np.linalg.norm(poses[:, 3:7], axis=1, keepdims=True)
        draw_scene(run, view, particles, clay_colours(view, particles), tool_surfaces(record, poses), width=560, quality=1)
        place = f"stage {stage.index + 1}/{record.stages[-1].index + 1}   step {int(time)}/{len(stage.positions) - 1}"
        title.set_text(f"{record.task.name}   {place}")
        canvas.draw()
        yield np.asarray(canvas.buffer_rgba())[..., :3].copy()


def _between(values: NDArray[np.float64], time: float) -> NDArray[np.float64]:
    """Values (T+1, ...) at a time between two steps."""
    first = min(int(time), len(values) - 1)
    second, share = min(first + 1, len(values) - 1), time - first
    return np.asarray((1.0 - share) * values[first] + share * values[second])


def _has_ffmpeg() -> bool:
    if importlib.util.find_spec("imageio_ffmpeg") is None:
        return False
    import imageio_ffmpeg  # type: ignore[import-untyped]

    try:
        imageio_ffmpeg.get_ffmpeg_exe()
    except RuntimeError:
        return False
    return True
