"""Figures as files: PDF and PNG, whose bytes depend on what is drawn alone."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from cpdeform.run.record_files import replacing

COLOURS = ("#1b6ca8", "#c8553d", "#588157", "#8e5aa8", "#d4a017", "#2a9d8f", "#6c757d", "#e07a9b", "#3d405b", "#9c6644")


def new_figure(rows: int, columns: int, *, width: float = 4.4, height: float = 3.2) -> tuple[Any, list[Any]]:
    """A figure and its axes, row by row.

    Args:
        rows: Number of rows.
        columns: Number of columns.
        width: Width of an axis, inches.
        height: Height of an axis, inches.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width * columns, height * rows), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    return figure, list(figure.subplots(rows, columns, squeeze=False).ravel())


def save_figure(figure: Any, path: Path) -> None:
    """Write ``path.pdf`` and ``path.png``."""
    for form, metadata in (("pdf", {"CreationDate": None}), ("png", {"Software": None})):
        with replacing(path.with_name(f"{path.name}.{form}")) as temporary:
            figure.savefig(temporary, format=form, dpi=130, metadata=metadata)


def colour(number: int) -> str:
    """The colour of the method with a number."""
    return COLOURS[number % len(COLOURS)]
