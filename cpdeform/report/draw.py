"""All pictures of a run."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from cpdeform.report.animation import draw_animation
from cpdeform.report.heights import draw_heights
from cpdeform.report.pictures import draw_picture
from cpdeform.report.sheet import draw_curves, draw_sheet
from cpdeform.run.record import load_record

PICTURES = ("picture", "sheet", "curves", "mp4", "gif", "heights")
"""What can be drawn."""

USUAL = ("picture", "sheet", "curves", "mp4")
"""What is drawn unless something else is asked for."""


def draw_run(directory: Path | str, *, camera: str | tuple[float, float] = "default") -> Path:
    """Draw ``picture.png`` and, where a plan was executed, ``animation.mp4`` from a run record.

    Args:
        directory: The record; the files are written into it.
        camera: Where to look from, see `cpdeform.report.pictures.direction_of`.

    Returns:
        Path of the picture.

    Raises:
        InputError: There is no record, it is damaged, no stage is complete, or the camera is none.
    """
    record = load_record(directory)
    picture = draw_picture(record, camera=camera)
    draw_animation(record, camera=camera)
    return picture


def draw_chosen(directory: Path | str, names: tuple[str, ...], *, camera: str | tuple[float, float] = "default") -> list[Path]:
    """Draw some of the pictures of a run record.

    Args:
        directory: The record; the files are written into it.
        names: What to draw, of `PICTURES`.
        camera: Where to look from, see `cpdeform.report.pictures.direction_of`.

    Returns:
        The files; an animation without an executed plan, and curves without iterations, are left out.

    Raises:
        InputError: There is no record, it is damaged, no stage is complete, or the camera is none.
    """
    record = load_record(directory)
    makers: dict[str, Callable[[], Path | None]] = {
        "picture": lambda: draw_picture(record, camera=camera),
        "sheet": lambda: draw_sheet(record, camera=camera),
        "curves": lambda: draw_curves(record),
        "mp4": lambda: draw_animation(record, camera=camera, form="mp4"),
        "gif": lambda: draw_animation(record, camera=camera, form="gif"),
        "heights": lambda: draw_heights(record),
    }
    return [path for name in names if (path := makers[name]()) is not None]
