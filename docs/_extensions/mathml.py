"""Equations as MathML, which browsers draw by themselves: pages need no script, no font and no network."""

from __future__ import annotations

from typing import Any

from docutils import nodes
from docutils.utils.math import MathError, latex2mathml
from sphinx.application import Sphinx
from sphinx.errors import ExtensionError
from sphinx.writers.html5 import HTML5Translator


def write(translator: HTML5Translator, node: nodes.math | nodes.math_block, *, block: bool) -> None:
    """Write an equation, and leave its node out."""
    try:
        equation = latex2mathml.tex2mathml(node.astext(), as_block=block)
    except MathError as error:
        raise ExtensionError(f"{node.source}: {node.astext()}: {error}") from error
    translator.body.append(f'<div class="math">{equation}</div>' if block else equation)
    raise nodes.SkipNode


def write_inline(translator: HTML5Translator, node: nodes.math) -> None:
    """Write an equation in a line of text."""
    write(translator, node, block=False)


def write_block(translator: HTML5Translator, node: nodes.math_block) -> None:
    """Write an equation of its own."""
    write(translator, node, block=True)


def setup(app: Sphinx) -> dict[str, Any]:
    """Register with Sphinx."""
    app.add_html_math_renderer("mathml", (write_inline, None), (write_block, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
