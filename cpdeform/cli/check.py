"""`cpdeform check`: whether parts keep their interfaces' contracts, and backends follow recorded rollouts."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import itertools
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    import torch

    from cpdeform.testing.golden import GoldenErrors
    from cpdeform.testing.report import Report

check = typer.Typer(no_args_is_help=True, help="Check a part that you wrote, or a backend against recorded rollouts.")

Name = Annotated[str, typer.Argument(help="Registered name, see `cpdeform plugins`.")]
Settings = Annotated[
    list[str] | None, typer.Option("--set", help="An option of the part, e.g. blur=0.01; repeatable.", metavar="KEY=VALUE")
]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]
Only = Annotated[list[str] | None, typer.Option(help="Only checks whose names contain this; repeatable.", metavar="TEXT")]
Device = Annotated[str, typer.Option(help="cpu or cuda.", metavar="NAME")]


def _show(report: Report, name: str, *, as_json: bool) -> None:
    """Print a report; exit code 1 where a check failed."""
    from cpdeform.run.record_files import to_json

    if as_json:
        typer.echo(json.dumps(to_json({"name": name, **report.to_dict()})))
    else:
        typer.echo(str(report))
    if not report.passed:
        raise typer.Exit(1)


def _quietly(as_json: bool) -> contextlib.AbstractContextManager[Any]:
    """Send what libraries print to stderr, where stdout is for JSON."""
    return contextlib.redirect_stdout(sys.stderr) if as_json else contextlib.nullcontext()


@check.command("simulator")
def check_simulator_command(
    name: Name, device: Device = "cpu", settings: Settings = None, only: Only = None, as_json: Json = False
) -> None:
    """Check a simulator: contract, conservation laws, closed forms, and gradients against differences (about ten seconds).

    Exit code 0: all passed; 1: a check failed; 2: unusable input.
    """
    from cpdeform.core.plugins import load_registry, split_options
    from cpdeform.testing.simulator import check_simulator

    factory = load_registry().load("simulator", name)
    with _quietly(as_json):
        report = check_simulator(functools.partial(factory, **split_options(settings or [])), device=device, only=only or [])
    _show(report, name, as_json=as_json)


@check.command("ot_solver")
def check_ot_solver_command(name: Name, settings: Settings = None, only: Only = None, as_json: Json = False) -> None:
    """Check a transport solver: closed forms, gauge, derivatives, weights, priorities, errors (some seconds).

    Exit code 0: all passed; 1: a check failed; 2: unusable input.
    """
    from cpdeform.core.plugins import load_registry, split_options
    from cpdeform.testing.ot import check_ot_solver

    with _quietly(as_json):
        report = check_ot_solver(load_registry().create("ot_solver", name, **split_options(settings or [])), only=only or [])
    _show(report, name, as_json=as_json)


@check.command("placer")
def check_placer_command(name: Name, settings: Settings = None, only: Only = None, as_json: Json = False) -> None:
    """Check a placer: collision, bounds, shapes, reproducibility (some seconds).

    Exit code 0: all passed; 1: a check failed; 2: unusable input.
    """
    from cpdeform.core.plugins import load_registry, split_options
    from cpdeform.testing.placer import check_placer

    with _quietly(as_json):
        report = check_placer(load_registry().create("placer", name, **split_options(settings or [])), only=only or [])
    _show(report, name, as_json=as_json)


@check.command("golden")
def check_golden_command(
    directory: Annotated[Path, typer.Argument(help="Folder with golden files, e.g. torus-v2-seed0.npz.", metavar="DIR")],
    backend: Annotated[list[str] | None, typer.Option(help="Simulator; repeatable. Defaults to warp.", metavar="NAME")] = None,
    scenes: Annotated[
        Path | None, typer.Option(help="Scene definitions. Defaults to DIR/../plasticinelab/scenes.json.", metavar="FILE")
    ] = None,
    goals: Annotated[
        Path | None, typer.Option(help="Target grids. Defaults to DIR/../plasticinelab/target_grids.npz.", metavar="FILE")
    ] = None,
    device: Device = "cpu",
    dtype: Annotated[str | None, typer.Option(help="float32 or float64. Defaults to the backend's.", metavar="NAME")] = None,
    settings: Settings = None,
    allow_unsupported: Annotated[
        bool, typer.Option("--allow-unsupported", help="Scenes that the backend declares it cannot run do not count as failures.")
    ] = False,
    markdown: Annotated[Path | None, typer.Option(help="Also write all errors as a Markdown page.", metavar="FILE")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print a JSON object a file, and a last one with all.")] = False,
) -> None:
    """Hold backends against rollouts and gradients recorded from PlasticineLab, one line a file.

    Exit code 0: all within tolerance; 1: one is not, or is not supported; 2: unusable input.
    """
    from cpdeform.core.errors import InputError
    from cpdeform.core.plugins import load_registry, split_options
    from cpdeform.experiments.golden_table import golden_command, golden_table
    from cpdeform.testing.golden import check_golden_file
    from cpdeform.testing.golden_file import golden_files

    if markdown is not None and not markdown.parent.is_dir():
        raise InputError("--markdown", came=str(markdown), expected="a file in a folder that exists")
    registry, real, names = load_registry(), _dtype(dtype), list(dict.fromkeys(backend or ["warp"]))
    with _quietly(as_json):
        simulators = {name: registry.load("simulator", name) for name in names}
    results: dict[str, list[GoldenErrors]] = {name: [] for name in names}
    for name, path in itertools.product(names, golden_files(directory)):
        factory = functools.partial(simulators[name], **split_options(settings or []))
        with _quietly(as_json):
            result = check_golden_file(path, factory, scenes=scenes, goals=goals, device=device, dtype=real)
        results[name].append(result)
        prefix = f"{name:<10}" if len(names) > 1 else ""
        typer.echo(json.dumps(_plain(name, result)) if as_json else f"{prefix}{result}")
    if markdown is not None:
        command = golden_command(names, device=device, dtype=dtype, settings=settings or [], out=markdown)
        markdown.write_text(golden_table(results, command=command, device=device, registry=registry), encoding="utf-8")
    accepted = {"passed", "unsupported"} if allow_unsupported else {"passed"}
    passed = all(result.status in accepted for found in results.values() for result in found)
    if as_json:
        files = [_plain(name, result) for name, found in results.items() for result in found]
        typer.echo(json.dumps({"backend": ",".join(names), "passed": passed, "files": files}))
    if not passed:
        raise typer.Exit(1)


def _plain(backend: str, result: GoldenErrors) -> dict[str, Any]:
    from cpdeform.run.record_files import to_json

    plain: dict[str, Any] = to_json({"backend": backend, **dataclasses.asdict(result)})
    return plain


def _dtype(name: str | None) -> torch.dtype | None:
    import torch

    from cpdeform.core.errors import UnknownNameError

    known = {"float32": torch.float32, "float64": torch.float64}
    if name is None:
        return None
    if name not in known:
        raise UnknownNameError("--dtype", name, known)
    return known[name]
