"""Every command that the documentation shows exists, with its options and the names that it is given."""

from __future__ import annotations

import importlib.util
import re
import shlex
import tomllib
from pathlib import Path
from typing import Any

import pytest
from doc_blocks import ROOT, Block, blocks, commands, pages
from typer.main import get_command

from cpdeform.cli.main import app
from cpdeform.core.plugins import Registry, load_registry, split_options
from cpdeform.core.reading.models import validate
from cpdeform.core.task import load_task
from cpdeform.run.configuration import RunConfiguration

SHOWN = [(block, line) for page in pages() for block in blocks(page, "bash", "console") for line in commands(block)]
OWN = [(block, line) for block, line in SHOWN if re.match(r"cpdeform (?!particles)", line)]
"""Those of cpdeform; docs/hooks.md adds the command `particles`, and another test runs it."""

FROM_HOOKS = {"sketch", "dense", "above", "patient", "here", "nudge"}
"""Names that the package of docs/hooks.md registers."""

OPTIONAL = {"ray", "slurm", "native"}
"""Names of parts that need not be installed."""

PARTS = {"backend": "simulator", "backends": "simulator", "ot": "ot_solver", "solvers": "ot_solver", "placer": "placer"} | {
    "strategy": "strategy",
    "engine": "engine",
}
"""Options whose values are names of parts, and what these are registered as."""

CHECKED = {"simulator": "simulator", "ot_solver": "ot_solver", "placer": "placer"}
"""Commands of `cpdeform check` whose argument is a part."""

TASKS = {"task", "tasks", "scene"}
"""Options and arguments whose values are tasks."""


def parsed(line: str) -> tuple[list[str], dict[str, Any]]:
    """The names of the command and its subcommand, and the values of their parameters, read as the command line reads them."""
    command: Any = get_command(app)
    context, rest, path = None, shlex.split(line)[1:], []
    name = "cpdeform"
    while True:
        context = command.make_context(name, list(rest), parent=context)
        if not hasattr(command, "resolve_command"):
            return path, context.params
        name, command, rest = command.resolve_command(context, [*context._protected_args, *context.args])
        path.append(name)


def in_list(value: Any) -> list[str]:
    """The entries of an option, repeated or separated by commas."""
    values = value if isinstance(value, (list, tuple)) else [value]
    return [part for item in values for part in str(item).split(",")]


def complaints(path: list[str], parameters: dict[str, Any], registry: Registry) -> list[str]:
    """Names and settings that nothing knows."""
    found = []
    given = {key: value for key, value in parameters.items() if value is not None and value != ()}
    for key, kind in PARTS.items():
        known = {*registry.names(kind), "auto", *FROM_HOOKS, *OPTIONAL}
        found += [f"{kind} {name}" for name in in_list(given.get(key, "auto")) if name not in known]
    if path[0] == "check" and path[1] in CHECKED and given["name"] not in {*registry.names(CHECKED[path[1]]), *FROM_HOOKS}:
        found.append(f"{path[1]} {given['name']}")
    for key in TASKS & given.keys():
        names = [name for name in in_list(given[key]) if not name.endswith(".yaml") and name not in FROM_HOOKS]
        for name in names:
            load_task(name, registry=registry)
    if path in (["run"], ["sweep", "new"], ["dataset", "new"], ["experiment"]):
        validate(RunConfiguration, split_options(given.get("settings", ())), source="--set")
    return found


@pytest.fixture(scope="module")
def registry() -> Registry:
    return load_registry()


@pytest.mark.parametrize(("block", "line"), OWN, ids=[f"{block.place}-{number}" for number, (block, _) in enumerate(OWN)])
def test_the_command_line_takes_it(block: Block, line: str, registry: Registry) -> None:
    path, parameters = parsed(line)
    assert complaints(path, parameters, registry) == []


def test_all_other_commands_exist() -> None:
    targets = set(re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    extras = set(tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"])
    wrong = []
    for block, line in SHOWN:
        words = shlex.split(line)
        match words[:3]:
            case ["make", *_] if words[1] not in targets:
                wrong.append(f"{block.place}: {line}")
            case ["python", "-m", module] if importlib.util.find_spec(module.partition(".")[0]) is None:
                wrong.append(f"{block.place}: {line}")
            case ["python", script, *_] if script.endswith(".py") and not (ROOT / script).exists():
                wrong.append(f"{block.place}: {line}")
            case ["pip", "install", *_]:
                for word in words[2:]:
                    name, bracket, asked = word.rstrip("]").partition("[")
                    missing = name.startswith("./") and not Path(ROOT / name).is_dir()
                    if missing or (bracket and name in ("cpdeform", ".") and not set(asked.split(",")) <= extras):
                        wrong.append(f"{block.place}: {line}")
    assert wrong == []


def test_most_pages_show_commands() -> None:
    assert len({block.page for block, _ in OWN}) > 12
    assert len(OWN) > 90
