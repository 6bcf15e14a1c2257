"""Lines that fit the terminal."""

from __future__ import annotations

import shutil
import sys
import textwrap

LEAST_WIDTH = 20
"""Columns of text beside the indent, in however narrow a terminal."""


def wrapped(line: str, *, indent: int) -> str:
    """A line broken at the width of the terminal; whole where the output is no terminal, since a program may read it.

    Args:
        line: One line.
        indent: Spaces before what goes on below.

    Returns:
        One line or several.
    """
    if not sys.stdout.isatty():
        return line
    width = shutil.get_terminal_size().columns
    # Names and paths stay in one piece, so that they can be copied.
    return textwrap.fill(
        line,
        max(width, indent + LEAST_WIDTH),
        subsequent_indent=" " * indent,
        break_on_hyphens=False,
        break_long_words=False,
    )
