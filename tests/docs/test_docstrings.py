"""The examples in docstrings give what they say."""

from __future__ import annotations

import doctest
import importlib
from pathlib import Path

import pytest

import cpdeform

PACKAGE = Path(cpdeform.__file__).parent
MODULES = [
    "cpdeform." + ".".join(path.relative_to(PACKAGE).with_suffix("").parts)
    for path in sorted(PACKAGE.rglob("*.py"))
    if ">>> " in path.read_text(encoding="utf-8")
]


@pytest.mark.parametrize("name", MODULES)
def test_examples_give_what_they_say(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)  # some write files
    found = doctest.testmod(importlib.import_module(name), optionflags=doctest.NORMALIZE_WHITESPACE)
    assert found.attempted > 0
    assert found.failed == 0


def test_the_public_entry_points_have_examples() -> None:
    names = {"Task.from_points", "Task.from_mesh", "OTSolver", "Placer", "deform"}
    for name in names:
        found: object = cpdeform
        for part in name.split("."):
            found = getattr(found, part)
        assert ">>> " in (found.__doc__ or ""), name
