"""The tutorial shows the code that runs."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[1]
BLOCKS = re.findall(r"^```(?:python|toml)\n(.*?)^```$", (FOLDER / "README.md").read_text(), re.DOTALL | re.MULTILINE)
FILES = [FOLDER / "pyproject.toml", *FOLDER.glob("cpdeform_example/*.py"), *FOLDER.glob("tests/*.py")]
SOURCES = [path.read_text() for path in FILES]


@pytest.mark.parametrize("block", BLOCKS, ids=range(len(BLOCKS)))
def test_block_is_a_piece_of_the_package(block: str) -> None:
    assert any(block in source for source in SOURCES)


def test_linked_files_exist() -> None:
    links = re.findall(r"\]\((?!http)([^)#]+)\)", (FOLDER / "README.md").read_text())
    assert links
    assert [link for link in links if not (FOLDER / link).exists()] == []
