"""A command from outside."""

from __future__ import annotations

from typing import Annotated

import typer

from cpdeform.core.errors import InputError


def greet(
    name: Annotated[str, typer.Argument(help="Who.")] = "world",
    times: Annotated[int, typer.Option(help="How often.")] = 1,
) -> None:
    """Greet somebody, several times if need be."""
    if times < 1:
        raise InputError("--times", came=str(times), expected="at least 1")
    typer.echo(" ".join([f"hello {name}"] * times))
