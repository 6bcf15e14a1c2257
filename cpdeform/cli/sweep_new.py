"""`cpdeform sweep new`: the jobs of a sweep."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

MOST_JOBS = 1_000_000
"""Jobs of a sweep at most: each is a few files."""


def new_command(
    directory: Annotated[Path, typer.Argument(help="Directory to make, which all workers see.", metavar="DIR")],
    tasks: Annotated[str, typer.Option(help="Names or YAML files, separated by commas.", metavar="NAMES")],
    seeds: Annotated[str, typer.Option(help="Seeds: numbers and ranges FIRST:END, separated by commas.", metavar="NUMBERS")] = "0",
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", help="Any option of `cpdeform run`, for all runs; repeatable.", metavar="KEY=VALUE"),
    ] = None,
    vary: Annotated[
        list[str] | None,
        typer.Option(
            help="An option with several values, runs for each; repeatable, then for every combination.", metavar="KEY=VALUE,..."
        ),
    ] = None,
    iterations: Annotated[
        int | None, typer.Option(help="Largest number of gradient steps per stage. Defaults to what fits the task.")
    ] = None,
    stages: Annotated[int | None, typer.Option(help="Number of stages. Defaults to the task's.")] = None,
    backend: Annotated[str | None, typer.Option(help="Simulator. Defaults to the fastest installed.", metavar="NAME")] = None,
    ot: Annotated[str | None, typer.Option(help="Optimal-transport solver. Defaults to the fastest.", metavar="NAME")] = None,
    threads: Annotated[int, typer.Option(help="Threads of each job.")] = 1,
) -> None:
    """Make the jobs of a sweep: every task with every variation and every seed. Nothing is run.

    Names and options are checked first. The same command again changes nothing.
    """
    from cpdeform.core.plugins import load_registry, split_options
    from cpdeform.core.task import merge
    from cpdeform.sweep.plan import SweepSettings, combinations, new_sweep

    given: dict[str, Any] = {"backend": backend, "ot": ot, "stages": stages}
    values = {name: value for name, value in given.items() if value is not None}
    if iterations is not None:
        values["optimizer"] = {"iterations": iterations}
    wanted = SweepSettings(
        tasks=tuple(part.strip() for part in tasks.split(",")),
        seeds=read_numbers(seeds, "--seeds"),
        settings=merge(split_options(settings or []), values),
        variations=combinations([_choice(text) for text in vary or []]),
        threads=threads,
    )
    queue = new_sweep(directory, wanted, registry=load_registry())
    typer.echo(f"{directory}: {len(queue.names())} jobs; do them with `cpdeform sweep work {directory}`")


def read_numbers(text: str, option: str) -> tuple[int, ...]:
    """Read whole numbers and ranges of them, separated by commas: ``0:3,7`` is 0, 1, 2, 7.

    Raises:
        InputError: A part is something else, a range is empty, or there are too many.
    """
    from cpdeform.core.errors import InputError

    found: list[int] = []
    for part in text.split(","):
        ends = [end.strip() for end in part.split(":")]
        if not (len(ends) in (1, 2) and all(end.isascii() and end.isdigit() and len(end) < 19 for end in ends)):
            raise InputError(option, came=f'"{part}"', expected="whole numbers, or ranges FIRST:END, separated by commas")
        first, end = int(ends[0]), int(ends[1]) if len(ends) == 2 else int(ends[0]) + 1
        if not first < end <= first + MOST_JOBS or len(found) + end - first > MOST_JOBS:
            raise InputError(option, came=f'"{part}"', expected=f"FIRST below END, {MOST_JOBS:,} numbers at most")
        found += range(first, end)
    return tuple(found)


def _choice(text: str) -> tuple[str, list[Any]]:
    """Read ``key=value,value``, values as YAML."""
    from cpdeform.core.errors import InputError
    from cpdeform.core.reading.yaml_text import parse_yaml

    key, equals, rest = text.partition("=")
    if not equals or not all(part.strip() for part in key.split(".")):
        remedy = "For example --vary optimizer.learning_rate=0.05,0.1"
        raise InputError("--vary", came=f'"{text}"', expected="key=value,value", remedy=remedy)
    values = parse_yaml(f"[{rest}]", argument=f"--vary {key}")
    if not isinstance(values, list) or not values:
        raise InputError("--vary", came=f'"{text}"', expected="key=value,value")
    return key.strip(), values
