"""Snippets of Python on the pages run, and so do the commands that are marked; with few particles, so that it takes seconds."""

from __future__ import annotations

import shlex
import warnings
from pathlib import Path
from typing import Any

import pytest
from doc_blocks import DOCS, READMES, Block, blocks, commands, pages
from typer.testing import CliRunner

from cpdeform.cli.main import app

ELSEWHERE = {DOCS / "hooks.md", *(page for page in READMES if page.parent.name == "cpdeform-example")}
"""Pages whose Python other tests hold against files."""

PAGES = [page for page in pages() if page not in ELSEWHERE and blocks(page, "python")]

FEW = "scene.bodies.0.particle_count=300"
SMALLER = {
    "run": ["--iterations", "1", "--no-pictures", "--set", "objective.points=300", "--set", FEW, "--steps", "3"],
    "report": ["--losers", "0", "--no-evaluate"],
    "task new": ["--particles", "400"],
}
"""What is added to a command that is run."""

SHORTER = {
    "subdivisions=3": "subdivisions=2",
    "step_count=10, stage_count=1)": "step_count=2, stage_count=1)",
    'load_task("pinch").scene\n': """load_task("pinch").scene
scene = scene.model_copy(update={"bodies": (scene.bodies[0].model_copy(update={"particle_count": 300}),)})
""",
    "deform(task, seed=0)": 'deform(task, seed=0, settings={"optimizer": {"iterations": 1}})',
    '{"iterations": 3}}': '{"iterations": 1}, "objective": {"points": 300}, "priorities": {"blur": 0.02}}',
    'few = {"scene"': 'few = {"objective": {"points": 300}, "scene"',
}
"""Parts of snippets and commands, and what takes their place."""


def shortened(text: str) -> str:
    for long, short in SHORTER.items():
        text = text.replace(long, short)
    return text


def run_command(line: str) -> None:
    """Run a command of cpdeform in this process."""
    words = shlex.split(shortened(line))[1:]
    extra = SMALLER.get(words[0]) or SMALLER.get(" ".join(words[:2])) or []
    if "--resume" in words:
        extra = extra[:5]  # the record says how many particles there are
    with warnings.catch_warnings():
        warnings.simplefilter("default")  # the command line prints warnings
        result = CliRunner().invoke(app, [*words, *extra])
    # 1: the command worked, and its answer is no, such as a run of a single iteration that gains nothing
    assert result.exit_code in (0, 1), f"{line}\n{result.output}\n{result.exception!r}"
    assert result.exception is None or isinstance(result.exception, SystemExit), f"{line}\n{result.exception!r}"


def run_python(block: Block, scope: dict[str, Any]) -> None:
    """Run a snippet in the scope of those before it."""
    lines = "\n" * (block.line - 1) + shortened(block.text)
    code = compile(lines, str(block.page), "exec")
    if block.mark != "parse":
        exec(code, scope)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name if page.parent == DOCS else f"{page.parent.name}/{page.name}")
def test_snippets_run(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    scope: dict[str, Any] = {"__name__": "snippet"}
    marked = {block.mark for block in blocks(page, "bash")}
    for block in blocks(page, "python", "bash"):
        if block.language == "python":
            run_python(block, scope)
        elif block.mark == "run":
            for line in commands(block):
                run_command(line)
    assert marked <= {"", "run"}
