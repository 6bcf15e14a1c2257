"""Errors that tell a user what came, what was expected, and what to do about it."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class CpdeformError(Exception):
    """Base class of every error this package raises on purpose; its text is meant for the user."""


class InputError(CpdeformError, ValueError):
    """An argument or a file that cannot be used as given.

    Args:
        argument: Name of the argument, option or field at fault.
        came: What was given, as short text.
        expected: What would have been accepted.
        remedy: What the user can do now.
    """

    def __init__(self, argument: str, *, came: str, expected: str, remedy: str = "") -> None:
        self.argument = argument
        self.came = came
        self.expected = expected
        self.remedy = remedy
        text = f"{argument}: got {came}, expected {expected}."
        super().__init__(f"{text} {remedy}" if remedy else text)


class UnknownNameError(InputError):
    """A name that no plugin registers, with the nearest names that do exist.

    Args:
        kind: What the name should denote, e.g. ``"simulator"``.
        name: The name that was asked for.
        known: The names that exist.
        remedy: Extra advice, e.g. which package would provide the name.
    """

    def __init__(self, kind: str, name: str, known: Iterable[str], *, remedy: str = "") -> None:
        names = sorted(known)
        near = difflib.get_close_matches(name, names, n=1, cutoff=0.5)
        hint = f'Did you mean "{near[0]}"?' if near else ""
        self.kind = kind
        self.name = name
        self.known = names
        super().__init__(
            kind,
            came=f'"{name}"',
            expected="one of " + (", ".join(names) if names else "nothing (none is installed)"),
            remedy=" ".join(part for part in (hint, remedy) if part),
        )


class MissingExtraError(CpdeformError, ImportError):
    """A part whose optional dependencies are not installed.

    Args:
        kind: What the part is, e.g. ``"simulator"``.
        name: Registered name of the part.
        module: The module that could not be imported.
        install: The exact command that installs it.
    """

    def __init__(self, kind: str, name: str, *, module: str, install: str) -> None:
        self.install = install
        super().__init__(f'{kind} "{name}" needs the Python module "{module}", which is not installed. Install it with: {install}')


class CapabilityError(CpdeformError):
    """A part was asked for something that it declares it cannot do."""


class RecordError(CpdeformError):
    """A run record that could not be written once the run had begun, e.g. because the disk is full."""


class PluginError(CpdeformError):
    """A plugin that registers something inconsistent, e.g. a name twice."""
