"""`cpdeform task show`: a picture of a task."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def show_command(
    task: Annotated[str, typer.Argument(help="A task's name or the path of a YAML file.", metavar="TASK")],
    out: Annotated[Path | None, typer.Option(help="Picture to write, .png. Defaults to TASK.png.", metavar="FILE")] = None,
) -> None:
    """Draw a task: the clay at the start with its tools, and the goal, from two sides."""
    from cpdeform.core.errors import InputError
    from cpdeform.core.task import load_task
    from cpdeform.report.task_picture import draw_task

    found = load_task(task)
    path = out or Path(f"{found.name}.png")
    if path.suffix != ".png":
        raise InputError("--out", came=str(path), expected="a file name that ends in .png")
    typer.echo(str(draw_task(found, path)))
