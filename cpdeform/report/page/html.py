"""The HTML file of a run's page: template, style, scripts and data in one piece."""

from __future__ import annotations

import base64
import html
import importlib.resources
import json
from collections.abc import Mapping
from typing import Any

from cpdeform.report.page.content import Page

SCRIPTS = (
    "elements.js",
    "source.js",
    "field.js",
    "mesher.js",
    "shading.js",
    "bodies.js",
    "scene.js",
    "curves.js",
    "panels.js",
    "player.js",
    "main.js",
)
"""Our scripts in the order in which they build on each other; together they are one module."""

LIBRARIES = "libraries.min.js"

EMBEDDED_POLICY = "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data: blob:"
"""What the page may load: nothing, so that it cannot ask the network for anything."""

LIVE_POLICY = f"{EMBEDDED_POLICY}; connect-src 'self'"


def embedded_page(page: Page) -> str:
    """The page as one file that holds its data.

    Args:
        page: What it shows.
    """
    parts = [f'<script type="application/json" id="content">{_json(page.content)}</script>']
    for name, make in page.arrays.items():
        data = base64.b64encode(make()).decode("ascii")
        parts.append(f'<script type="application/octet-stream" id="{html.escape(name)}">{data}</script>')
    return _page(str(page.content["name"]), "\n".join(parts), policy=EMBEDDED_POLICY)


def live_page(name: str) -> str:
    """The page as a file that asks the server that it came from for its data, again and again.

    Args:
        name: Name of the task.
    """
    return _page(name, "", policy=LIVE_POLICY)


def _page(name: str, data: str, *, policy: str) -> str:
    values = {
        "policy": policy,
        "title": html.escape(f"{name} - cpdeform"),
        "style": _read("page.css") + _read("uplot.min.css"),
        "libraries": _read(LIBRARIES),
        "scripts": "\n".join(_read(script) for script in SCRIPTS),
        "data": data,
    }
    return _fill(_read("page.html"), values)


def _fill(template: str, values: Mapping[str, str]) -> str:
    """Put each value where the template has its name in double braces; values are not searched again."""
    pieces = template.split("{{")
    filled = [pieces[0]]
    for piece in pieces[1:]:
        name, rest = piece.split("}}", 1)
        filled += [values[name], rest]
    return "".join(filled)


def _json(content: Mapping[str, Any]) -> str:
    """JSON that cannot end the element it stands in."""
    return json.dumps(content, allow_nan=False).replace("<", "\\u003c")


def _read(name: str) -> str:
    return importlib.resources.files("cpdeform.report.page").joinpath("static", name).read_text(encoding="utf-8")
