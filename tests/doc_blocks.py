"""The fenced blocks of the documentation, for the tests that run them."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
READMES = (ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "SECURITY.md", *sorted((ROOT / "plugins").glob("*/README.md")))

FENCE = re.compile(r"^(?:<!-- test: (?P<mark>\w+) -->\n)?```(?P<language>\w+)\n(?P<text>.*?)^```$", re.DOTALL | re.MULTILINE)
"""A fenced block, and the mark in a comment before it that says what the tests do with it."""


@dataclasses.dataclass(frozen=True)
class Block:
    """A fenced block.

    Attributes:
        page: Where it is.
        line: Number of its first line.
        language: What stands behind the fence.
        text: Its lines.
        mark: What the tests are told to do with it; empty for what they do by themselves.
    """

    page: Path
    line: int
    language: str
    text: str
    mark: str

    @property
    def place(self) -> str:
        """Where it is, for messages."""
        return f"{self.page.relative_to(ROOT)}:{self.line}"


def pages() -> list[Path]:
    """All pages that people read and nobody generates."""
    return [*READMES, *sorted(path for path in DOCS.rglob("*.md") if "_build" not in path.parts)]


def blocks(page: Path, *languages: str) -> list[Block]:
    """Fenced blocks of a page in some languages."""
    text = page.read_text(encoding="utf-8")
    found = []
    for match in FENCE.finditer(text):
        if match["language"] in languages:
            line = text.count("\n", 0, match.start("text")) + 1
            found.append(Block(page, line, match["language"], match["text"], match["mark"] or ""))
    return found


def commands(block: Block) -> list[str]:
    """The commands of a block of shell, comments left out and continued lines joined."""
    joined = block.text.replace("\\\n", " ")
    lines = [re.sub(r"(^|\s)#.*$", "", line).removeprefix("$ ").strip() for line in joined.splitlines()]
    return [line for line in lines if line]
