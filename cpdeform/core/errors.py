"""Errors that tell a user what came, what was expected, and what to do about it."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from typing import Any

MESSAGE_LENGTH = 300
"""The most characters of an `InputError`'s text: what came may be of any length, and a user reads the first lines."""

_SHARES = {"came": 70, "expected": 90, "remedy": 70}
"""What a part of a message keeps at least, in the order in which they are shortened; the argument takes the rest."""


def brief(text: str, limit: int) -> str:
    """A text on one line, without characters that cannot be printed, of at most `limit` characters.

    What is too long loses its middle, since the end of a path or of a list says as much as its beginning.

    Args:
        text: Any text.
        limit: The most characters, at least 8.
    """
    if len(text) > 4 * limit:
        text = text[: 2 * limit] + text[-2 * limit :]
    line = " ".join(text.encode("utf-8", "backslashreplace").decode("utf-8").split())
    line = "".join(sign if sign.isprintable() else sign.encode("unicode_escape").decode("ascii") for sign in line)
    if len(line) <= limit:
        return line
    head = (limit - 3) * 2 // 3
    return line[:head] + "..." + line[len(line) - (limit - 3 - head) :]


class CpdeformError(Exception):
    """Base class of every error this package raises on purpose; its text is meant for the user."""

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickled as it is: an error comes back from another process as it was raised there, whatever its constructor takes."""
        return _restored, (type(self), self.args, dict(self.__dict__))


def _restored(kind: type[CpdeformError], arguments: tuple[Any, ...], attributes: dict[str, Any]) -> CpdeformError:
    """An error that was pickled."""
    error = kind.__new__(kind)
    error.args = arguments
    error.__dict__.update(attributes)
    return error


class InputError(CpdeformError, ValueError):
    """An argument or a file that cannot be used as given.

    The text is one line of at most `MESSAGE_LENGTH` characters, whatever came.

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
        super().__init__(_message({"argument": argument, "came": came, "expected": expected, "remedy": remedy}))


def _message(parts: dict[str, str]) -> str:
    """One line of an error's parts, the longest of them shortened where it would be too long."""
    parts = {name: brief(text, MESSAGE_LENGTH) for name, text in parts.items()}
    for name, share in _SHARES.items():
        excess = len(_joined(parts)) - MESSAGE_LENGTH
        if excess > 0:
            parts[name] = brief(parts[name], max(len(parts[name]) - excess, share))
    excess = len(_joined(parts)) - MESSAGE_LENGTH
    if excess > 0:
        parts["argument"] = brief(parts["argument"], max(len(parts["argument"]) - excess, 8))
    return _joined(parts)


def _joined(parts: dict[str, str]) -> str:
    text = f"{parts['argument']}: got {parts['came']}, expected {parts['expected']}."
    return f"{text} {parts['remedy']}" if parts["remedy"] else text


def nearest_name(name: str, names: Iterable[str]) -> str | None:
    """The name that was probably meant: one that has this word (``rate``) or these initials (``lr``), or the most alike.

    Args:
        name: What was typed.
        names: The names that exist.
    """
    known, typed = sorted(names), name[:100].lower()
    if not typed:
        return None
    words = {candidate: candidate.lower().split("_") for candidate in known}
    initials = {candidate: "".join(word[:1] for word in found) for candidate, found in words.items()}
    spoken = [item for item in known if len(words[item]) > 1 and (typed == initials[item] or typed in words[item])]
    near = spoken[:1] or difflib.get_close_matches(typed, known, n=1, cutoff=0.5)
    if not near and len(typed) > 2:
        near = [item for item in known if any(word.startswith(typed) for word in words[item])]
    return near[0] if near else None


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
        near = nearest_name(name, names)
        hint = f'Did you mean "{near}"?' if near is not None else ""
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


class EngineError(CpdeformError):
    """Workers of a sweep that cannot be started, or that end before they have done anything."""
