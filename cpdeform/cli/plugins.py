"""`cpdeform plugins`: which parts are installed, from where, and whether they can be used."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from cpdeform.core.plugins import Registration, Registry


def plugins(as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False) -> None:
    """List simulators, transport solvers, placers and tasks, and the plugins that failed to load.

    Every part is imported, to tell whether it can be used; this takes some seconds.
    """
    from cpdeform.cli.wrapped import wrapped
    from cpdeform.core.plugins import load_registry

    registry = load_registry()
    parts = [_describe(registry, registration) for registration in registry.registrations()]
    failures = [
        {"entry_point": failure.entry_point, "distribution": failure.distribution, "reason": failure.reason}
        for failure in registry.failures
    ]
    if as_json:
        typer.echo(json.dumps({"plugins": parts, "failures": failures}))
        return
    kind = ""
    tasks = [part for part in parts if part["kind"] == "task" and part["available"]]
    width = max((len(part["name"]) for part in parts if part not in tasks), default=0)
    for part in parts:
        if part in tasks:
            continue
        if part["kind"] != kind:
            kind = part["kind"]
            typer.echo(kind)
        typer.echo(wrapped(f"  {part['name']:<{width}} {part['summary']}  [{part['distribution']}]", indent=width + 3))
        if not part["available"]:
            typer.echo(wrapped(f"  {'':<{width}} not available: {part['reason']}", indent=width + 3))
    if tasks:
        typer.echo(f"task\n  {len(tasks)} tasks, see `cpdeform tasks`")
    for failure in failures:
        line = f"failed to load: {failure['entry_point']} [{failure['distribution']}]: {failure['reason']}"
        typer.echo(wrapped(line, indent=width + 3))


def _describe(registry: Registry, registration: Registration) -> dict[str, Any]:
    from cpdeform.core.errors import CpdeformError
    from cpdeform.core.task import task_path

    spec, reason = registration.spec, ""
    try:
        if registration.kind == "task":
            path = task_path(spec.name, registry=registry)
            reason = "" if path.is_file() else f"no such file: {path}"
        else:
            registry.load(registration.kind, spec.name)
    except CpdeformError as error:
        reason = str(error)
    return {
        "kind": registration.kind,
        "name": spec.name,
        "distribution": registration.distribution,
        "summary": spec.summary,
        "available": not reason,
        "reason": reason,
    }
