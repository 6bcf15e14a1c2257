"""Heights of clay seen from above, as a relief in grey: what is written into a board can be read there."""

from __future__ import annotations

import textwrap
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cpdeform.report.clay import sample_mesh
from cpdeform.report.pictures import describe
from cpdeform.report.surface import clay_surface, particle_spacing
from cpdeform.run.record import RunRecord
from cpdeform.run.record_files import replacing

Array = NDArray[np.float64]

PIXEL = 0.002
"""Edge of a pixel, length units."""

AROUND = 0.02
"""Space around the clay, length units."""

SMOOTHING = 0.8
"""Standard deviation that makes particles a surface, in their spacing: less than in other pictures, so that grooves stay."""

SHOWN = (2.0, 98.0)
"""Percentiles of the goal's heights that are drawn black and white."""


def height_map(particles: Array, *, window: tuple[float, float, float, float], spacing: float | None = None) -> Array:
    """Height of the clay's surface above each place.

    Args:
        particles: Positions (N, 3), length units.
        window: Least and greatest x, then least and greatest z, length units.
        spacing: Edge of the cube that a particle has to itself, length units; defaults to `particle_spacing`.

    Returns:
        Heights (rows, columns), length units: z grows from row to row, x from column to column, by `PIXEL`. nan beside the clay.
    """
    left, right, back, front = window
    shape = (max(1, round((front - back) / PIXEL)), max(1, round((right - left) / PIXEL)))
    heights = np.full(shape, -np.inf)
    mesh = clay_surface(particles, spacing=spacing, smoothing=SMOOTHING)
    # Crumbs, which no surface shows, are dots.
    points = np.concatenate([sample_mesh(mesh, 0.7 * PIXEL)[0], particles[mesh.loose]])
    rows, columns = (np.floor((points[:, axis] - low) / PIXEL).astype(np.int64) for axis, low in ((2, back), (0, left)))
    inside = (rows >= 0) & (rows < shape[0]) & (columns >= 0) & (columns < shape[1])
    np.maximum.at(heights, (rows[inside], columns[inside]), points[inside, 1])
    return np.where(np.isfinite(heights), heights, np.nan)


def window_around(*clouds: Array) -> tuple[float, float, float, float]:
    """The smallest window around some clouds of particles, with a little space.

    Args:
        clouds: Positions (N, 3) each, length units.

    Returns:
        Least and greatest x, then least and greatest z, length units; for `height_map`.
    """
    low = np.min([np.nanmin(cloud, axis=0) for cloud in clouds], axis=0) - AROUND
    high = np.max([np.nanmax(cloud, axis=0) for cloud in clouds], axis=0) + AROUND
    return float(low[0]), float(high[0]), float(low[2]), float(high[2])


def draw_heights(record: RunRecord) -> Path:
    """Draw ``heights.png`` into the record's directory: start, result and goal from above, the lower the darker.

    Args:
        record: The run.

    Raises:
        InputError: No stage is complete.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    start, result = (state.position[0].double().cpu().numpy() for state in (record.stages[0].state_before, record.state))
    goal = record.goal.double().cpu().numpy()
    window, spacing = window_around(start, goal), particle_spacing(start)
    reliefs = {
        "start": height_map(start, window=window, spacing=spacing),
        "result": height_map(result, window=window, spacing=spacing),
        "goal": height_map(goal, window=window, spacing=particle_spacing(goal)),
    }
    least, most = np.nanpercentile(reliefs["goal"], SHOWN)
    wide = (window[1] - window[0]) / (window[3] - window[2]) > 1.0
    figure = Figure(figsize=(6.4, 7.2) if wide else (10.5, 4.2), dpi=110, layout="constrained", facecolor="white")
    canvas = FigureCanvasAgg(figure)
    axes = figure.subplots(*((3, 1) if wide else (1, 3)))
    for axis, (name, heights) in zip(axes, reliefs.items(), strict=True):
        picture = axis.imshow(heights, cmap="gray", vmin=least, vmax=max(most, least + 1e-6), interpolation="bilinear")
        axis.set_title(name, fontsize=10)
        axis.set_axis_off()
    figure.colorbar(picture, ax=axes, shrink=0.6, label="height, domain edges")
    figure.suptitle("\n".join(textwrap.wrap(describe(record), 64 if wide else 110)), fontsize=10)
    path = record.directory / "heights.png"
    with replacing(path) as temporary:
        canvas.print_figure(temporary, format="png")
    return path
