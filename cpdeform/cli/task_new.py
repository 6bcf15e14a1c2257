"""`cpdeform task new`: a task from meshes or a picture."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, cast

import typer


def new_command(
    name: Annotated[str, typer.Argument(help="Name of the task and of its files.", metavar="NAME")],
    goal: Annotated[
        Path,
        typer.Option(help="Shape wanted: a mesh (.stl, .obj, .ply, .glb), or a picture (.png, .jpg) as a relief.", metavar="FILE"),
    ],
    start: Annotated[Path | None, typer.Option(help="Mesh that the clay starts as. Defaults to a block.", metavar="FILE")] = None,
    tool: Annotated[
        Path | None, typer.Option(help="Mesh of the tool. Defaults to two blocks, for a picture to a pen.", metavar="FILE")
    ] = None,
    up: Annotated[
        str | None, typer.Option(help="Axis that points upwards in the meshes: x, y or z. Defaults to the format's.")
    ] = None,
    folder: Annotated[Path, typer.Option(help="Where the files are written.", metavar="DIR")] = Path(),
    particles: Annotated[int, typer.Option(help="Number of particles of clay.")] = 10_000,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace files that are there.")] = False,
) -> None:
    """Make a task from your own meshes: `cpdeform task new vase --goal vase.stl`, then `cpdeform run vase.yaml`.

    Meshes are repaired where that is safe, and refused with the reason where it is not. The goal is scaled to the clay's volume,
    put on the floor and filled evenly with particles. What was done, and what `cpdeform task check` would say, is printed.
    """
    from cpdeform.core.bounded import MOST_PARTICLES
    from cpdeform.core.errors import InputError
    from cpdeform.run.checks.check import check_task
    from cpdeform.tasks.new import Request, new_task

    if up not in (None, "x", "y", "z"):
        raise InputError("--up", came=up or "", expected="x, y or z")
    if not 100 <= particles <= MOST_PARTICLES:
        raise InputError("--particles", came=str(particles), expected=f"from 100 to {MOST_PARTICLES}")
    axis = cast(Literal["x", "y", "z"] | None, up)
    request = Request(
        name=name, goal=goal, start=start, tool=tool, up=axis, folder=folder, particles=particles, overwrite=overwrite
    )
    made = new_task(request)
    for note in made.notes:
        typer.echo(note)
    for finding in check_task(made.task):
        typer.echo(f"{finding.severity}: {finding.kind}: {finding}")
    typer.echo(f"{made.path}: run it with `cpdeform run {made.path}`, look at it with `cpdeform task show {made.path}`")
