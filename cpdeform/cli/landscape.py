"""`cpdeform experiment landscape`: losses from every start on a board, beside transport priorities."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
import shlex
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from cpdeform.cli.bench_output import check_device, split_names, split_numbers
from cpdeform.cli.interruption import exit_code
from cpdeform.core.errors import InputError

if TYPE_CHECKING:
    from cpdeform.core.plugins import Registry
    from cpdeform.experiments.studies.landscape import LandscapeSettings, Start

TAKEN = ("tasks", "seeds", "iterations", "particles", "backend", "ot", "device", "settings", "size", "out", "resume", "as_json")
"""Options of `cpdeform experiment` that the landscape has."""


def landscape(given: dict[str, Any]) -> None:
    """Compute the landscape and write it after every row.

    Args:
        given: Options of `cpdeform experiment`; None or False for those that were not given.

    Raises:
        InputError: An option cannot be used here.
    """
    from cpdeform.core.plugins import load_registry
    from cpdeform.experiments.studies.landscape import compute
    from cpdeform.run.record_files import check_directory

    others = [key for key, value in given.items() if key not in TAKEN and value not in (None, False)]
    if others:
        raise InputError("landscape", came=", ".join(f"--{key.replace('_', '-')}" for key in others), expected="other options")
    registry = load_registry()
    settings = _settings(given, registry)
    check_directory(settings.out, overwrite=True)
    starts: list[Start] = []
    with contextlib.redirect_stdout(sys.stderr):
        rows = compute(settings, registry=registry, resume=given["resume"], on_row=lambda row: typer.echo(f"row {row}", err=True))
        _collect(rows, starts, settings, _made_by(given, settings, registry))
    if given["as_json"]:
        typer.echo(json.dumps({"experiment": "landscape", "starts": [_plain(start) for start in starts], "out": str(settings.out)}))
    else:
        typer.echo((settings.out / "summary.md").read_text(encoding="utf-8"))
        typer.echo(f"written to {settings.out / 'summary.md'}")
    if not any(math.isfinite(start.loss_ratio) for start in starts):
        raise typer.Exit(1)


def _collect(rows: Iterator[list[Start]], starts: list[Start], settings: LandscapeSettings, made_by: str) -> None:
    from cpdeform.experiments.studies.landscape_summary import write_landscape

    planned = settings.size**2
    try:
        for row in rows:
            starts.extend(row)
            write_landscape(starts, settings.out, task=settings.task, planned=planned, made_by=made_by)
    except KeyboardInterrupt as error:
        typer.echo(f"cpdeform: interrupted after {len(starts)} of {planned} starts; the same command goes on from here", err=True)
        raise typer.Exit(exit_code(error)) from error


def _settings(given: Mapping[str, Any], registry: Registry) -> LandscapeSettings:
    from cpdeform.core.options import whole_number
    from cpdeform.core.plugins import split_options
    from cpdeform.core.task import load_task, merge
    from cpdeform.experiments.experiment_plan import with_particles
    from cpdeform.experiments.studies.landscape import LandscapeSettings

    tasks = split_names(given["tasks"], "--tasks") if given["tasks"] else ["writer"]
    if len(tasks) != 1:
        raise InputError("--tasks", came=", ".join(tasks), expected="one task")
    if given["device"] is not None:
        check_device(given["device"])
    values = split_options(given["settings"] or [])
    named = {key: given[key] for key in ("backend", "ot", "device") if given[key] is not None}
    if given["iterations"] is not None:
        named["optimizer"] = {"iterations": given["iterations"]}
    values = merge(values, named)
    if given["particles"] is not None:
        values["scene"] = with_particles(load_task(tasks[0], registry=registry), values.get("scene", {}), given["particles"])
    size = 20 if given["size"] is None else whole_number("--size", given["size"], least=2, most=1000)
    seed = split_numbers(given["seeds"], "--seeds")[0] if given["seeds"] else 0
    out = given["out"] or Path("experiments") / "landscape"
    return LandscapeSettings(out=out, task=tasks[0], size=size, seed=seed, values=values)


def _made_by(given: Mapping[str, Any], settings: LandscapeSettings, registry: Registry) -> str:
    """Command, machine and versions."""
    from cpdeform.experiments.experiment_row import without_directories
    from cpdeform.experiments.tables import describe_machine, describe_versions, machine_line

    words = ["cpdeform", "experiment", "landscape"]
    for key in TAKEN:
        for value in given[key] if isinstance(given[key], (list, tuple)) else [given[key]]:
            if value not in (None, False, True):
                words += [f"--{'set' if key == 'settings' else key.replace('_', '-')}", str(value)]
    machine = describe_machine(device=given["device"] or "cpu")
    return f"- `{without_directories(shlex.join(words))}` on {machine_line(machine, describe_versions(registry))}"


def _plain(start: Start) -> dict[str, Any]:
    values = dataclasses.asdict(start)
    return {name: None if isinstance(value, float) and not math.isfinite(value) else value for name, value in values.items()}
