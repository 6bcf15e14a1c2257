"""Which package may import which: arrows point downwards, and no files import each other in a circle."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import cpdeform

ROOT = Path(cpdeform.__file__).parent

LAYERS = (
    ("core",),
    ("planning", "ot", "backends", "placement"),
    ("run",),
    ("testing", "report", "sweep"),
    ("experiments", "tasks"),
    ("datasets",),
    ("cli",),
)
"""Packages from the lowest layer to the highest; one may import from itself and from the layers below its own."""

PUBLIC = ("__init__", "__main__")
"""Modules at the top, which import from anywhere."""


def level(package: str) -> int:
    return next(number for number, names in enumerate(LAYERS) if package in names)


def modules() -> dict[str, Path]:
    return {".".join(path.relative_to(ROOT.parent).with_suffix("").parts): path for path in sorted(ROOT.rglob("*.py"))}


def for_types(node: ast.AST) -> bool:
    return isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING"


def imported(path: Path, known: dict[str, Path], *, types: bool) -> Iterator[str]:
    """Modules of the project that a file imports anywhere: at its top, on use, or (with `types`) for type annotations alone."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    left_out = {id(inner) for node in ast.walk(tree) if for_types(node) and not types for inner in ast.walk(node)}
    for node in ast.walk(tree):
        if id(node) in left_out:
            continue
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name in known)
        elif isinstance(node, ast.ImportFrom) and node.module and node.module.partition(".")[0] == "cpdeform":
            for alias in node.names:
                name = f"{node.module}.{alias.name}"
                yield name if name in known else node.module if node.module in known else f"{node.module}.__init__"


def graph(*, types: bool) -> dict[str, set[str]]:
    known = modules()
    return {name: set(imported(path, known, types=types)) - {name} for name, path in known.items()}


def test_every_package_has_a_layer() -> None:
    packages = {path.parent.name for path in ROOT.glob("*/__init__.py")}
    assert packages == {name for names in LAYERS for name in names}


def test_arrows_point_downwards() -> None:
    wrong = []
    for name, targets in graph(types=True).items():
        package = name.split(".")[1]
        if package in PUBLIC:
            continue
        for target in targets:
            other = target.split(".")[1]
            if other not in (package, *PUBLIC) and level(other) >= level(package):
                wrong.append(f"{name} imports {target}")
    assert not wrong, "\n".join(wrong)


def test_no_circles() -> None:
    edges = graph(types=False)
    done: set[str] = set()

    def visit(name: str, path: tuple[str, ...]) -> None:
        assert name not in path, " -> ".join((*path[path.index(name) :], name))
        if name not in done:
            for target in sorted(edges.get(name, ())):
                visit(target, (*path, name))
            done.add(name)

    for name in edges:
        visit(name, ())
