"""Picture and animation of a run."""

from __future__ import annotations

from pathlib import Path

from cpdeform.report.animation import draw_animation
from cpdeform.report.pictures import draw_picture
from cpdeform.run.record import load_record


def draw_run(directory: Path | str) -> Path:
    """Draw ``picture.png`` and, where a plan was executed, ``animation.mp4`` from a run record.

    Args:
        directory: The record; the files are written into it.

    Returns:
        Path of the picture.

    Raises:
        InputError: There is no record, it is damaged, or no stage is complete.
    """
    record = load_record(directory)
    picture = draw_picture(record)
    draw_animation(record)
    return picture
