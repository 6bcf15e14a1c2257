"""Lines that fit the terminal."""

from __future__ import annotations

import shutil
import sys
import textwrap


def wrapped(line: str, *, indent: int) -> str:
    """A line broken at the width of the terminal; whole where the output is no terminal, since a program may read it.

    Args:
        line: One line.
        indent: Spaces before what goes on below.
    """
    if not sys.stdout.isatty():
        return line
    width = shutil.get_terminal_size().columns
    return textwrap.fill(
        line,
        max(width, indent + 20),
        subsequent_indent=" " * indent,
        drop_whitespace=True,
        replace_whitespace=False,
        break_on_hyphens=False,
        break_long_words=False,
    )
