"""Docstrings that people read in an editor, made fit for reStructuredText.

Several docstrings on a page may each have a reference [1], and a bar is the absolute value of something, not a substitution.
"""

from __future__ import annotations

import re
from typing import Any

from sphinx.application import Sphinx
from sphinx.util.inspect import signature, stringify_signature

BEFORE_NAPOLEON = 400
DEFINITION = re.compile(r"^(\s*)\.\. \[(\d+)\] ")
BAR = re.compile(r"(`+[^`]*`+)|\|")
CITATION = re.compile(r"\[(\d+)\]_")


def plain_references(app: Sphinx, what: str, name: str, obj: object, options: object, lines: list[str]) -> None:
    """Turn numbered footnotes of a docstring into list items, what cites them into text, and bars into bars."""
    for number, line in enumerate(lines):
        item = DEFINITION.sub(r"\1* \\[\2] ", line)
        plain = CITATION.sub(r"[\1]", item)
        lines[number] = BAR.sub(lambda match: match[1] or "\\|", plain)


def constructor(
    app: Sphinx, what: str, name: str, obj: Any, options: object, arguments: str | None, returned: str | None
) -> tuple[str, str | None] | None:
    """Show the constructor of classes whose `__new__` takes anything, such as simulators and transport solvers."""
    if what != "class" or arguments is None or not arguments.startswith("(*args"):
        return None
    own = signature(obj.__init__, bound_method=True)
    return stringify_signature(own, show_return_annotation=False, unqualified_typehints=True), returned


def setup(app: Sphinx) -> dict[str, Any]:
    """Register with Sphinx."""
    app.connect("autodoc-process-docstring", plain_references, priority=BEFORE_NAPOLEON)
    app.connect("autodoc-process-signature", constructor)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
