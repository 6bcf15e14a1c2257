"""`cpdeform config`, `replay` and `verify`: what a record says, and whether it holds."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Annotated

import typer

Record = Annotated[Path, typer.Argument(help="A run record, see `cpdeform run --out`.", metavar="DIR")]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]


def config(
    directory: Record,
    origin: Annotated[bool, typer.Option("--origin", help="Print where each value comes from.")] = False,
    command: Annotated[bool, typer.Option("--command", help="Print the command that repeats the run instead.")] = False,
    as_json: Json = False,
) -> None:
    """Print the configuration of a recorded run.

    Origins: given (a flag, --set, or Python), object (a part in Python), record (the run that this one goes on from), strategy
    (its settings), auto (chosen among what is installed), default.

    Examples:
      cpdeform config runs/star --origin

      cpdeform config runs/star --command
    """
    import yaml

    from cpdeform.core.errors import InputError
    from cpdeform.run.command import command_of, recorded_origins
    from cpdeform.run.origins import flatten
    from cpdeform.run.record import load_record
    from cpdeform.run.resume import recorded_configuration

    record = load_record(directory)
    if command:
        line = command_of(record)
        if line is None:
            raise InputError(
                "--command", came="a run made in Python with objects of its own", expected="one that a command line has"
            )
        typer.echo(json.dumps({"command": line}) if as_json else line)
        return
    content = recorded_configuration(record).model_dump(mode="json")
    if not origin:
        typer.echo(json.dumps(content) if as_json else yaml.safe_dump(content, sort_keys=False).rstrip())
        return
    origins = recorded_origins(record)
    rows = {path: {"value": value, "origin": origins.get(path, "default")} for path, value in flatten(content).items()}
    if as_json:
        typer.echo(json.dumps(rows))
        return
    width = max(map(len, rows))
    for path, row in rows.items():
        typer.echo(f"{path:<{width}}  {row['origin']:<8}  {json.dumps(row['value'])}")


def replay(
    directory: Record,
    backend: Annotated[str | None, typer.Option(help="Another simulator. Defaults to the record's own.", metavar="NAME")] = None,
    device: Annotated[str | None, typer.Option(help="cpu or cuda. Defaults to the record's.", metavar="NAME")] = None,
    as_json: Json = False,
) -> None:
    """Repeat the plans that a run found, and print how far the clay ends from where the record has it.

    Each stage is repeated from the recorded state, and, chained, from where the repetition of the stage before ended.

    Examples:
      cpdeform replay runs/star

      cpdeform replay runs/star --backend warp
    """
    from cpdeform.run.record import load_record
    from cpdeform.run.replay import recorded_simulator
    from cpdeform.run.verify import replay_record

    record = load_record(directory)
    simulator = recorded_simulator(record, backend=backend, device=device)
    rows = []
    for row in replay_record(record, simulator):
        rows.append(dataclasses.asdict(row))
        if not as_json:
            alone, chained = f"mean {row.mean:.2g}, largest {row.largest:.2g}", f"{row.chained_mean:.2g}, {row.chained_largest:.2g}"
            typer.echo(f"stage {row.stage + 1}: distance {alone}; chained {chained}  (edges of the domain)")
    if as_json:
        typer.echo(json.dumps({"record": str(directory), "simulator": type(simulator).__name__, "stages": rows}))
    elif not rows:
        typer.echo("no plan was executed")


def verify(
    directory: Record,
    backend: Annotated[str | None, typer.Option(help="Another simulator. Defaults to the record's own.", metavar="NAME")] = None,
    as_json: Json = False,
) -> None:
    """Compute the figures of a recorded run again, and say where they differ.

    Exit code 0: all hold; 1: some do not; 2: unusable input.

    Examples:
      cpdeform verify runs/star
    """
    from cpdeform.run.record import load_record
    from cpdeform.run.record_files import to_json
    from cpdeform.run.verify import verify_record

    checks = []
    for check in verify_record(load_record(directory), backend=backend):
        checks.append(check)
        if not as_json:
            mark = "holds  " if check.holds else "DIFFERS"
            typer.echo(f"{mark}  {check.name}: recorded {check.recorded:.6g}, found {check.found:.6g}")
    wrong = [check for check in checks if not check.holds]
    if as_json:
        rows = [{**dataclasses.asdict(check), "holds": check.holds} for check in checks]
        typer.echo(json.dumps(to_json({"record": str(directory), "checks": rows, "differ": len(wrong)})))
    else:
        typer.echo(f"{len(checks) - len(wrong)} of {len(checks)} figures hold")
    if wrong:
        raise typer.Exit(1)
