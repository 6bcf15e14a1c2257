"""The animation of a run: every executed step of every stage."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cpdeform.report.pictures import View, clay_colours, draw_scene, make_view, tool_surfaces
from cpdeform.run.record import RunRecord
from cpdeform.run.record_files import replacing

FRAMES_PER_SECOND = 6
HOLD_SECONDS = 1.0
"""How long the last frame stands still."""

MAX_FRAMES = 120
"""More steps than this are thinned out, so that long runs are drawn in seconds, too."""


def draw_animation(record: RunRecord) -> Path | None:
    """Draw ``animation.mp4``, or ``animation.gif`` where ffmpeg is missing.

    Args:
        record: Is drawn into its own directory.

    Returns:
        Path of the animation; None where no plan was executed.
    """
    import imageio.v2

    frames = list(_select(record))
    if not frames:
        return None
    pictures = list(_draw_frames(record, make_view(record), frames))
    pictures += [pictures[-1]] * round(HOLD_SECONDS * FRAMES_PER_SECOND)
    path = record.directory / ("animation.mp4" if _has_ffmpeg() else "animation.gif")
    if path.suffix == ".mp4":
        options: dict[str, Any] = {"fps": FRAMES_PER_SECOND, "codec": "libx264", "quality": 8}
        form = "FFMPEG"
    else:
        options, form = {"duration": 1000.0 / FRAMES_PER_SECOND, "loop": 0}, "GIF"
    with replacing(path) as temporary:
        writer: Any = imageio.v2.get_writer(str(temporary), format=form, mode="I", **options)
        with writer:
            for picture in pictures:
                writer.append_data(picture)
    return path


def _select(record: RunRecord) -> Iterator[tuple[int, int]]:
    """Stage and step of each frame: all steps, or evenly spread ones where there are too many."""
    steps = [
        (number, step)
        for number, stage in enumerate(record.stages)
        if stage.positions is not None
        for step in range(len(stage.positions))
    ]
    count = min(len(steps), MAX_FRAMES)
    return (steps[index] for index in np.linspace(0, len(steps) - 1, count).round().astype(int)) if steps else iter(())


def _draw_frames(record: RunRecord, view: View, frames: list[tuple[int, int]]) -> Iterator[NDArray[np.uint8]]:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.2, 6.4), dpi=100, facecolor="white")
    canvas: Any = FigureCanvasAgg(figure)
    for number, step in frames:
        stage = record.stages[number]
        if stage.positions is None or stage.tool_poses is None:
            continue
        figure.clear()
        axis = figure.add_axes((0.0, 0.0, 1.0, 0.93))
        particles = stage.positions[step].double().numpy()
        tools = tool_surfaces(record, stage.tool_poses[step].double().numpy())
        draw_scene(axis, view, particles, clay_colours(view, particles), tools, width=560, quality=1)
        text = (
            f"{record.task.name}   stage {stage.index + 1}/{record.stages[-1].index + 1}   step {step}/{len(stage.positions) - 1}"
        )
        figure.text(0.5, 0.96, text, ha="center", va="center", fontsize=12)
        canvas.draw()
        yield np.asarray(canvas.buffer_rgba())[..., :3].copy()


def _has_ffmpeg() -> bool:
    if importlib.util.find_spec("imageio_ffmpeg") is None:
        return False
    import imageio_ffmpeg  # type: ignore[import-untyped]

    try:
        imageio_ffmpeg.get_ffmpeg_exe()
    except RuntimeError:
        return False
    return True
