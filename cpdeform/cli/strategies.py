"""`cpdeform strategies`: how a search can go."""

from __future__ import annotations

import json
from typing import Annotated

import typer


def strategies(as_json: Annotated[bool, typer.Option("--json", help="Print one JSON array.")] = False) -> None:
    """List the strategies that are installed; `cpdeform run TASK --strategy NAME` takes one."""
    from cpdeform.core.plugins import load_registry

    rows = [
        {"name": item.spec.name, "summary": item.spec.summary, "distribution": item.distribution}
        for item in load_registry().registrations("strategy")
    ]
    if as_json:
        typer.echo(json.dumps(rows))
        return
    width = max((len(row["name"]) for row in rows), default=0)
    for row in rows:
        typer.echo(f"{row['name']:<{width}}  {row['summary']}  [{row['distribution']}]")
