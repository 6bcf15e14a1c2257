"""`cpdeform task generate`: random goals for a task's scene."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def generate_command(
    task: Annotated[str, typer.Argument(help="Task whose scene the goal is for, or a YAML file.", metavar="SCENE")],
    seed: Annotated[int, typer.Option(help="Below 1000: for tuning; from 1000 on: for reporting only.", metavar="N")],
    out: Annotated[Path, typer.Option(help="Goal file to write, .npz.", metavar="FILE")],
    backend: Annotated[str, typer.Option(help="Simulator that it comes to rest in, in float64.", metavar="NAME")] = "auto",
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace a file that is there.")] = False,
) -> None:
    """Make a random goal for `cpdeform run SCENE --goal FILE`: solids, ropes, cubes, letters and strokes, dents.

    Goals are at rest, and within reach of the tools. The same seed gives the same file, bit for bit. Seeds below 1000 are for
    tuning a method, seeds from 1000 on for reporting results only.
    """
    from cpdeform.core.errors import InputError
    from cpdeform.core.task import load_task
    from cpdeform.tasks.generate.goal import generate_goal

    if seed < 0:
        raise InputError("--seed", came=str(seed), expected="0 or more; from 1000 on for reporting only")
    if out.suffix != ".npz":
        raise InputError("--out", came=str(out), expected="a file name that ends in .npz")
    if out.exists() and not overwrite:
        raise InputError("--out", came=f"{out}, which exists", expected="a new file", remedy="Use --overwrite to replace it.")
    goal = generate_goal(load_task(task), seed=seed, backend=backend)
    goal.write(out)
    purpose = "for reporting only" if goal.for_reporting else "for tuning"
    typer.echo(f"{out}: {goal.kind} for {goal.task}, {len(goal.position)} particles, seed {seed} ({purpose})")
