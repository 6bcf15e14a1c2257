"""What the commands of `cpdeform bench` share: reading of lists, progress on stderr, a table or JSON on stdout."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import typer

if TYPE_CHECKING:
    from cpdeform.core.plugins import Registry

UNFOLDED = 10_000
"""Width of a terminal that no table is folded for, characters."""


def report(
    rows: Sequence[Mapping[str, Any]],
    settings: Mapping[str, Any],
    registry: Registry,
    columns: Mapping[str, tuple[str, str]],
    note: str,
    *,
    device: str,
    as_json: bool,
) -> None:
    """Print what a bench found, as a table or as JSON; exit code 1 where no row has figures."""
    from cpdeform.experiments.tables import describe_machine, describe_versions, machine_line
    from cpdeform.run.record_files import to_json

    machine, versions = describe_machine(device=device), describe_versions(registry)
    if as_json:
        content = {"rows": list(rows), "machine": machine, "versions": versions, "settings": settings}
        typer.echo(json.dumps(to_json(content)))
    else:
        _print_table(rows, columns)
        typer.echo(f"{note}\n{machine_line(machine, versions)}")
    if all(row["error"] is not None for row in rows):
        raise typer.Exit(1)


def _print_table(rows: Iterable[Mapping[str, Any]], columns: Mapping[str, tuple[str, str]]) -> None:
    """Print a table; a row without figures has its reason below it."""
    from rich import box
    from rich.console import Console
    from rich.measure import Measurement
    from rich.table import Table

    from cpdeform.experiments.tables import cell

    table = Table(box=box.SIMPLE_HEAD)
    for number, (title, _) in enumerate(columns.values()):
        table.add_column(title, justify="left" if number == 0 else "right")
    failures = []
    for row in rows:
        table.add_row(*(cell(row[name], pattern) for name, (_, pattern) in columns.items()))
        if row["error"] is not None:
            failures.append(f"{_name(row)}: {row['error']}")
    # A table that is piped into a file is not folded to a terminal's width.
    console = Console() if sys.stdout.isatty() else Console(width=200)
    wanted = Measurement.get(console, console.options.update(max_width=UNFOLDED), table).maximum
    if wanted > console.width:
        _print_blocks(rows, columns)
    else:
        console.print(table)
    for failure in failures:
        typer.echo(failure)


def print_markdown(text: str) -> None:
    """Print a page of Markdown: drawn on a terminal, as it is into a file."""
    if not sys.stdout.isatty():
        typer.echo(text)
        return
    from rich.console import Console
    from rich.markdown import Markdown

    Console().print(Markdown(text))


def _print_blocks(rows: Iterable[Mapping[str, Any]], columns: Mapping[str, tuple[str, str]]) -> None:
    """Print each row as lines of a title and a figure, for a terminal that is too narrow for the table."""
    from cpdeform.experiments.tables import cell

    width = max(len(title) for title, _ in columns.values())
    for row in rows:
        for name, (title, pattern) in columns.items():
            typer.echo(f"{title:<{width}}  {cell(row[name], pattern)}")
        typer.echo("")


def told(rows: Iterable[dict[str, Any]], *, count: int) -> Iterator[dict[str, Any]]:
    """Pass rows on and say on stderr how far the bench is."""
    for number, row in enumerate(rows, start=1):
        typer.echo(f"{number}/{count}  {_name(row)}{'' if row['error'] is None else ': ' + row['error']}", err=True)
        yield row


def _name(row: Mapping[str, Any]) -> str:
    """What a row is about: its text and whole-number fields."""
    parts = [str(row[name]) for name in ("backend", "solver") if name in row]
    parts += [f"{name} {row[name]:,}" for name in ("particles", "points", "worlds", "threads", "seed") if name in row]
    return ", ".join(parts)


def split_names(text: str, option: str) -> list[str]:
    """Read names separated by commas.

    Raises:
        InputError: One is empty.
    """
    from cpdeform.core.errors import InputError

    parts = [part.strip() for part in text.split(",")]
    if not all(parts):
        raise InputError(option, came=f'"{text}"', expected="entries separated by commas")
    return parts


def split_numbers(text: str, option: str) -> tuple[int, ...]:
    """Read whole numbers separated by commas; their range is not checked here.

    Raises:
        InputError: One is something else.
    """
    from cpdeform.core.errors import InputError

    try:
        return tuple(int(part) for part in split_names(text, option))
    except InputError:
        raise
    except ValueError as error:
        raise InputError(option, came=f'"{text}"', expected="whole numbers separated by commas") from error


def check_device(device: str) -> None:
    """Raise `InputError` unless it is the name of a device; whether there is one is the backend's to say."""
    from cpdeform.core.errors import InputError
    from cpdeform.core.task import validate
    from cpdeform.run.configuration import RunConfiguration

    try:
        validate(RunConfiguration, {"device": device}, source="bench")
    except InputError as error:
        raise InputError("--device", came=error.came, expected=error.expected) from error
