"""Help texts from docstrings, whose lines are broken for an editor and not for the terminal at hand."""

from __future__ import annotations

import inspect

import typer


def unwrap_help(app: typer.Typer) -> None:
    """Join the lines of each paragraph in the help of all commands: rich breaks them anew, but keeps breaks that are there."""
    for command in app.registered_commands:
        if command.help is None and command.callback is not None and command.callback.__doc__:
            command.help = unwrapped(command.callback.__doc__)
    for group in app.registered_groups:
        if group.typer_instance is not None:
            unwrap_help(group.typer_instance)


def unwrapped(text: str) -> str:
    """A docstring with each paragraph on one line; those with indented lines, such as examples, stay as they are."""
    paragraphs = inspect.cleandoc(text).split("\n\n")
    return "\n\n".join(part if "\n " in part or part.startswith(" ") else part.replace("\n", " ") for part in paragraphs)
