"""`cpdeform task`: new tasks, their pictures and checks, and files that they are made of."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cpdeform.cli.task_check import task_check_command
from cpdeform.cli.task_generate import generate_command
from cpdeform.cli.task_new import new_command
from cpdeform.cli.task_show import show_command

if TYPE_CHECKING:
    from cpdeform.tasks.grid_import import ImportedGrid

task = typer.Typer(no_args_is_help=True, help="Make tasks, look at them, check them, and make files that they are made of.")


@task.callback()
def task_group() -> None:
    """Make tasks, look at them, check them, and make files that they are made of."""


task.command("new")(new_command)
task.command("show")(show_command)
task.command("check")(task_check_command)


task.command("generate")(generate_command)


@task.command("import-grid")
def import_grid_command(
    file: Annotated[Path, typer.Argument(help="Node masses: a dense .npy or .npz, or a sparse .npz.", metavar="FILE")],
    out: Annotated[Path, typer.Option(help="Goal file to write, .npz; with --all a directory.", metavar="GOAL")],
    task: Annotated[
        str | None, typer.Option(help="Task whose scene it is for. Defaults to the task with the grid's name.", metavar="TASK")
    ] = None,
    name: Annotated[str | None, typer.Option(help="Which grid, if the file holds several.", metavar="NAME")] = None,
    particles: Annotated[int | None, typer.Option(help="Number of particles. Defaults to the body's.")] = None,
    seed: Annotated[int, typer.Option(help="Seed of the sample.")] = 0,
    every: Annotated[bool, typer.Option("--all", help="Import all grids that a task is known for: GOAL/<task>.npz.")] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace files that are there.")] = False,
) -> None:
    """Turn a target grid of PlasticineLab into a goal file for `cpdeform run TASK --goal GOAL`.

    The goal's particles are an even sample whose own node masses are the grid's; the file also keeps the grid.
    """
    from cpdeform.core.bounded import MOST_SEED
    from cpdeform.core.errors import InputError
    from cpdeform.tasks.grid_import import import_grids

    if not 0 <= seed <= MOST_SEED:
        raise InputError("--seed", came=str(seed), expected=f"0 or more, at most {MOST_SEED}")
    if not every:
        _import_one(file, out, task, name, particles, seed, overwrite=overwrite)
        return
    given = {"--task": task, "--name": name, "--particles": particles}
    for flag, value in given.items():
        if value is not None:
            raise InputError(flag, came=str(value), expected="nothing with --all", remedy="Import that grid alone, without --all.")
    import_grids(file, out, seed=seed, overwrite=overwrite, on_imported=_show)
    typer.echo(_SAMPLING)


def _import_one(
    file: Path, out: Path, task: str | None, name: str | None, particles: int | None, seed: int, *, overwrite: bool
) -> None:
    from cpdeform.core.errors import InputError
    from cpdeform.core.task import load_task
    from cpdeform.tasks.grid_import import check_output, choose_grid, import_grid, read_grids, task_name

    if out.suffix != ".npz":
        raise InputError("--out", came=str(out), expected="a file name that ends in .npz")
    grids = read_grids(file)
    name = choose_grid(grids, name, path=file)
    task = task or task_name(name)
    if task is None:
        raise InputError("--task", came="none", expected=f'a task, since the name "{name}" does not tell which', remedy=_TASKS)
    found = load_task(task)
    check_output(out, overwrite=overwrite)
    _show(import_grid(grids[name], found, name=name, path=out, particles=particles, seed=seed))
    typer.echo(_SAMPLING)


_SAMPLING = (
    "A grid that PlasticineLab simulated holds the random density of its own particles; "
    "run these goals with --set scene.sampling=plasticinelab."
)
_TASKS = "`cpdeform tasks` lists them."


def _show(result: ImportedGrid) -> None:
    """Tell of an imported goal, and whether it lies lower than its task's clay gets, as where PlasticineLab's body begins lower."""
    from cpdeform.core.sampling import sample_particles
    from cpdeform.run.checks.goal_height import check_goal_below_floor

    figures = f"{len(result.position)} particles, error of the node masses {result.error:.2g}, {result.seconds:.1f} s"
    typer.echo(f"{result.path}: {result.name} for {result.task}, {figures}")
    for finding in check_goal_below_floor(result.scene, sample_particles(result.scene), result.position):
        typer.echo(f"{finding.severity}: {finding.kind}: {finding}")
