"""`cpdeform tasks`: what can be run by name."""

from __future__ import annotations

import json
from typing import Annotated

import typer


def tasks(as_json: Annotated[bool, typer.Option("--json", help="Print one JSON array.")] = False) -> None:
    """List the tasks that are installed, with their variants."""
    from cpdeform.core.errors import CpdeformError
    from cpdeform.core.plugins import load_registry
    from cpdeform.core.task import list_variants, task_path

    registry = load_registry()
    rows = []
    for registration in registry.registrations("task"):
        spec = registration.spec
        problem, variants = "", []
        try:
            variants = list_variants(task_path(spec.name, registry=registry))
        except CpdeformError as error:
            problem = str(error)
        rows.append({"name": spec.name, "variants": variants, "summary": spec.summary, "problem": problem})
    if as_json:
        typer.echo(json.dumps(rows))
        return
    for row in rows:
        variants_text = f"  (variants {', '.join(row['variants'])})" if row["variants"] else ""
        typer.echo(f"{row['name']}{variants_text}\n    {row['problem'] or row['summary']}")
    if not rows:
        typer.echo("no tasks are installed")
