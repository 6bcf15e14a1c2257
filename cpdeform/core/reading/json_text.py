"""JSON of unknown origin: the text files of run records, and definitions of scenes."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from cpdeform.core.errors import InputError
from cpdeform.core.reading.boundary import boundary, open_file, read_text
from cpdeform.core.reading.limits import ReadingLimits


def parse_json(text: str, *, argument: str, limits: ReadingLimits | None = None) -> Any:
    """Read a JSON text.

    Args:
        text: The text; its length is the caller's to check.
        argument: Where it comes from, for messages.
        limits: What depth is accepted.

    Raises:
        InputError: It is no JSON, or nested too deep.
    """
    limits = limits or ReadingLimits()
    with boundary(argument, expected="JSON"):
        content = json.loads(text)
    layer = [content]
    for _ in range(limits.depth):
        layer = [entry for value in layer if isinstance(value, (dict, list)) for entry in _entries(value)]
    if layer:
        raise InputError(argument, came="unreadable content (nested too deep)", expected=f"JSON at most {limits.depth} deep")
    return content


def read_json(path: Path, *, argument: str, limits: ReadingLimits | None = None) -> Any:
    """Read a JSON file; see `parse_json`.

    Args:
        path: The file, UTF-8.
        argument: What it is, for messages.
        limits: What is accepted.

    Raises:
        InputError: It cannot be read, is too long, or as for `parse_json`.
    """
    limits = limits or ReadingLimits()
    expected = f"JSON of at most {limits.text_bytes} bytes"
    text = read_text(path, argument=argument, expected=expected, limit=limits.text_bytes)
    return parse_json(text, argument=argument, limits=limits)


def read_json_lines(path: Path, *, argument: str, limits: ReadingLimits | None = None) -> Iterator[dict[str, Any]]:
    """Read a file with a JSON object a line, all lines but a last one that was cut off.

    Args:
        path: The file, UTF-8.
        argument: What it is, for messages.
        limits: What is accepted.

    Raises:
        InputError: The file cannot be read, or a line is too long or no JSON object.
    """
    limits = limits or ReadingLimits()
    expected = f"a JSON object a line, each of at most {limits.line_bytes} bytes"
    with open_file(path, argument=argument, expected=expected) as file:
        read = number = 0
        while True:
            line = file.readline(limits.line_bytes + 1)
            number += 1
            read += len(line)
            if len(line) > limits.line_bytes or read > limits.array_bytes:
                raise InputError(f"{argument}: line {number}", came="too much text", expected=expected)
            if not line.endswith(b"\n"):
                return
            content = parse_json(line.decode("utf-8"), argument=f"{argument}: line {number}", limits=limits)
            if not isinstance(content, dict):
                raise InputError(f"{argument}: line {number}", came=type(content).__name__, expected=expected)
            yield content


def _entries(value: dict[str, Any] | list[Any]) -> list[Any]:
    return list(value.values()) if isinstance(value, dict) else value
