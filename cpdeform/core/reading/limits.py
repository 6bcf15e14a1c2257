"""How much a file may hold before it is refused."""

from __future__ import annotations

import dataclasses
import os

MEBIBYTE = 2**20
VARIABLE = "CPDEFORM_READ_LIMIT_MB"
"""Environment variable that raises (or lowers) `ReadingLimits.array_bytes` for a whole command, in MiB."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ReadingLimits:
    """What a reader accepts; what is larger is refused before memory is taken for it.

    Attributes:
        array_bytes: Bytes of one array, and of all arrays that are read from one file.
        members: Arrays in a file.
        text_bytes: Bytes of a YAML or JSON text.
        line_bytes: Bytes of a line where a text is read line by line.
        nodes: Values in a YAML text, those that aliases and merge keys repeat counted each time.
        depth: Lists and mappings inside each other.
        scalar_characters: Characters of one value of a YAML text.
    """

    array_bytes: int = 256 * MEBIBYTE
    members: int = 10_000
    text_bytes: int = MEBIBYTE
    line_bytes: int = MEBIBYTE
    nodes: int = 50_000
    depth: int = 50
    scalar_characters: int = 10_000


def default_limits() -> ReadingLimits:
    """The limits of a command: those of `ReadingLimits`, that of arrays as the environment variable `VARIABLE` sets it."""
    text = os.environ.get(VARIABLE, "")
    if not (text.isascii() and text.isdigit() and len(text) < 10):
        return ReadingLimits()
    return ReadingLimits(array_bytes=int(text) * MEBIBYTE)
