"""`cpdeform task check`: what in a task would go wrong without a word."""

from __future__ import annotations

import dataclasses
import json
from typing import Annotated

import typer


def task_check_command(
    task: Annotated[
        str, typer.Argument(help="A task's name, with or without a variant, or the path of a YAML file.", metavar="TASK")
    ],
    as_json: Annotated[bool, typer.Option("--json", help="Print one object as the last line.")] = False,
) -> None:
    """Report tools that clay passes through, bodies that stick, and goals that cannot be reached.

    Errors and warnings are faults of the task: with one of them the exit status is 1. Notes may be intended.
    """
    from cpdeform.core.task import load_task
    from cpdeform.run.checks.check import check_task

    found = load_task(task)
    findings = check_task(found)
    for finding in findings:
        typer.echo(f"{finding.severity}: {finding.kind}: {finding}")
    faults = [finding for finding in findings if finding.severity != "note"]
    if as_json:
        rows = [dataclasses.asdict(finding) for finding in findings]
        typer.echo(json.dumps({"task": found.name, "passed": not faults, "findings": rows}))
    elif not faults:
        typer.echo(f"{found.name}: nothing is wrong")
    if faults:
        raise typer.Exit(1)
