"""`cpdeform dataset`: plans for generated goals as a data set, and episodes of one simulated again."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from cpdeform.datasets.build import BuiltDataset
    from cpdeform.datasets.replay import Replay

MOST_LOSS_DIFFERENCE = 0.02
"""How far the loss on another simulator may be from the recorded one, over that."""

dataset = typer.Typer(help="Data sets of plans for generated goals.", no_args_is_help=True)


@dataset.command("new")
def new_command(
    directory: Annotated[Path, typer.Argument(help="Directory to make; its name is the data set's.", metavar="NAME")],
    scene: Annotated[str, typer.Option(help="Task whose scene the goals are for, or a YAML file.", metavar="TASK")],
    goals: Annotated[str, typer.Option(help="Seeds of the goals: numbers and ranges FIRST:END.", metavar="NUMBERS")],
    settings: Annotated[
        list[str] | None, typer.Option("--set", help="Any option of `cpdeform run`; repeatable.", metavar="KEY=VALUE")
    ] = None,
    iterations: Annotated[
        int | None, typer.Option(help="Largest number of gradient steps per stage. Defaults to what fits the task.")
    ] = None,
    stages: Annotated[int | None, typer.Option(help="Number of stages. Defaults to the task's.")] = None,
    strategy: Annotated[str | None, typer.Option(help="How to search. Defaults to cpdeform.", metavar="NAME")] = None,
    backend: Annotated[str | None, typer.Option(help="Simulator. Defaults to the fastest installed.", metavar="NAME")] = None,
    seed: Annotated[int, typer.Option(help="Seed of the plans.")] = 0,
    threads: Annotated[int, typer.Option(help="Threads of each plan.")] = 1,
    particles: Annotated[int, typer.Option(help="Particles of an observation.")] = 1000,
    success_iou: Annotated[float, typer.Option(help="Normalised incremental IoU that counts as a success.")] = 0.5,
    shard_size: Annotated[int, typer.Option(help="Episodes of a file.")] = 100,
    licence: Annotated[str, typer.Option(help="Licence of the data, an SPDX identifier.", metavar="NAME")] = "CC-BY-4.0",
    workers: Annotated[
        int | None, typer.Option(help="Workers at the same time. Defaults to as many as there is room for.", metavar="N")
    ] = None,
    engine: Annotated[str, typer.Option(help="Where workers run: local, ray or slurm.", metavar="NAME")] = "local",
    no_work: Annotated[
        bool, typer.Option("--no-work", help="Plan nothing; make the jobs, and write the data set of the plans that are done.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object as the last line.")] = False,
) -> None:
    """Plan for generated goals and write NAME/dataset: ManiSkill's layout, a Minari data set, checksums and a card.

    The same command continues where it stopped, and plans for new goals if there are more. `cpdeform sweep work NAME` lets other
    machines help. Exit code 0: there is a data set; 1: no goal has a plan; 2: unusable input.
    """
    from cpdeform.cli.sweep import work_on
    from cpdeform.cli.sweep_new import read_numbers
    from cpdeform.core.plugins import load_registry, split_options
    from cpdeform.core.task import merge
    from cpdeform.datasets.build import build_dataset
    from cpdeform.datasets.job_plan import new_dataset
    from cpdeform.datasets.settings import DatasetSettings
    from cpdeform.sweep.queue import DONE
    from cpdeform.sweep.worker import WorkSettings

    given: dict[str, Any] = {"stages": stages, "strategy": strategy, "backend": backend}
    values: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
    if iterations is not None:
        values["optimizer"] = {"iterations": iterations}
    wanted = DatasetSettings(
        scene=scene,
        goals=read_numbers(goals, "--goals"),
        settings=merge(split_options(settings or []), values),
        seed=seed,
        threads=threads,
        particles=particles,
        success_iou=success_iou,
        shard_size=shard_size,
        licence=licence,
    )
    registry = load_registry()
    queue = new_dataset(directory, wanted, registry=registry)
    if not no_work:
        work_on(queue, registry.create("engine", engine, workers=workers), WorkSettings())
    if not queue.listed(DONE):
        left = f"{directory}: {len(queue.names())} jobs; plan with `cpdeform sweep work {directory}`, then give this command again"
        typer.echo(left if no_work else f"{directory}: no goal has a plan; see `cpdeform sweep status {directory}`")
        raise typer.Exit(0 if no_work else 1)
    _print_built(build_dataset(queue, wanted, name=directory.resolve().name), as_json=as_json)


@dataset.command("replay")
def replay_command(
    directory: Annotated[Path, typer.Argument(help="Data set, or the directory that it was made in.", metavar="DIR")],
    episodes: Annotated[str | None, typer.Option(help="Numbers and ranges FIRST:END. Defaults to all.", metavar="NUMBERS")] = None,
    backend: Annotated[str | None, typer.Option(help="Simulator. Defaults to that of the data set.", metavar="NAME")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Simulate episodes again and compare where they end.

    Exit code 0: on the data set's own simulator every particle is where it was, on another one every loss is within 2%; 1: not so.
    """
    from cpdeform.cli.sweep_new import read_numbers
    from cpdeform.datasets.replay import replay

    rows: list[Replay] = []
    for row in replay(directory, episodes=None if episodes is None else read_numbers(episodes, "--episodes"), backend=backend):
        rows.append(row)
        typer.echo(_replay_line(row), err=as_json)
    good = [row.equal if backend is None else row.loss_difference <= MOST_LOSS_DIFFERENCE for row in rows]
    if as_json:
        typer.echo(json.dumps({"replays": [dataclasses.asdict(row) for row in rows], "good": sum(good)}))
    else:
        what = "end where the data set has them" if backend is None else f"have a loss within {MOST_LOSS_DIFFERENCE:.0%}"
        typer.echo(f"{sum(good)} of {len(rows)} episodes {what}")
    if not all(good) or not rows:
        raise typer.Exit(1)


def _replay_line(row: Replay) -> str:
    where = "equal" if row.equal else f"particles up to {row.distance:.2g} away"
    losses = f"loss {row.loss:.5g}, recorded {row.recorded_loss:.5g} ({row.loss_difference:.2%} apart)"
    return f"episode {row.number} on {row.backend}: {where}; {losses}"


def _print_built(built: BuiltDataset, *, as_json: bool) -> None:
    succeeded = sum(item["success"] for item in built.episodes)
    if as_json:
        content = {"out": str(built.directory), "episodes": len(built.episodes), "successes": succeeded}
        typer.echo(json.dumps({**content, "without_plan": built.without_plan, "minari": built.minari}))
        return
    typer.echo(f"{built.directory}: {len(built.episodes)} episodes, {succeeded} of them successes; see README.md there")
    for job, reason in built.without_plan.items():
        typer.echo(f"  left out {job}: {reason}")
    if not built.minari:
        typer.echo('  no Minari data set: pip install "cpdeform[datasets]", then give the command again')
