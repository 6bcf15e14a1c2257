"""Relative links that serve readers of the repository lead to pages of the site, too.

Pages and the README files of the plugins link to each other, and to source files, by paths in the repository. On the site a README
is a page, a source file is a download, and a folder is plain text.
"""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any

from sphinx.application import Sphinx

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
LINK = re.compile(r"(?P<image>!?)\[(?P<text>(?:[^\[\]]|`[^`]*`)*)\]\((?P<target>[^()\s#]+)(?P<anchor>#[^()\s]*)?\)")
PAGES = {
    ROOT / "README.md": DOCS / "index.md",
    **{ROOT / f"{name.upper()}.md": DOCS / f"{name}.md" for name in ("contributing", "security", "changelog")},
    **{
        ROOT / "plugins" / f"cpdeform-{name}" / "README.md": DOCS / "plugins" / f"{name}.md"
        for name in ("example", "native", "gymnasium", "baselines")
    },
}
"""Files of the repository that are pages of the site."""


def rewritten(content: str, *, source: Path, page: Path) -> str:
    """The Markdown text of `source` as part of `page`, links changed where they have to be."""

    def replace(match: re.Match[str]) -> str:
        target = match["target"]
        if re.match(r"[a-z]+:", target):
            return match[0]
        path = (source.parent / target).resolve()
        if path.is_dir() and not match["image"]:
            return match["text"]
        found = os.path.relpath(PAGES.get(path, path), page.parent)
        return f"{match['image']}[{match['text']}]({found}{match['anchor'] or ''})"

    return LINK.sub(replace, content)


def change_page(app: Sphinx, docname: str, content: list[str]) -> None:
    """Change the links of a page."""
    page = Path(app.env.doc2path(docname)).resolve()
    content[0] = rewritten(content[0], source=page, page=page)


def change_included(app: Sphinx, relative_path: Path, parent_docname: str, content: list[str]) -> None:
    """Change the links of a file that a page includes."""
    source = (DOCS / relative_path).resolve()
    # MyST gives the page's name without its folder
    page = Path(app.env.doc2path(app.env.current_document.docname)).resolve()
    content[0] = rewritten(content[0], source=source, page=page)


def setup(app: Sphinx) -> dict[str, Any]:
    """Register with Sphinx."""
    app.connect("source-read", change_page)
    app.connect("include-read", change_included)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
