"""`cpdeform bench ot`: what transport solvers cost on this machine."""

from __future__ import annotations

import contextlib
import dataclasses
import sys
from collections.abc import Mapping
from typing import Annotated

import typer

from cpdeform.cli.bench_output import check_device, report, split_names, split_numbers, told

OT_COLUMNS: Mapping[str, tuple[str, str]] = {
    "solver": ("solver", ""),
    "threads": ("threads", "d"),
    "points": ("points", ",d"),
    "cold_ms": ("cold ms", ",.0f"),
    "warm_ms": ("warm ms", ",.1f"),
    "cold_gradient_cosine": ("cold cosine", ".4f"),
    "warm_gradient_cosine": ("warm cosine", ".4f"),
    "value_error_against_exact": ("error of the value", "+.2%"),
    "peak_memory_mb": ("peak MB", ".0f"),
}
"""Title and format of each column."""

OT_NOTE = (
    "Cosines are with the converged gradient of the same blur, the warm one after all steps of 1e-3 RMS; the value's error is "
    "against the exact cost, blur included. Peak: above the process before the cold solution. MB are 1e6 bytes."
)


def bench_ot_command(
    solvers: Annotated[
        str | None, typer.Option(help="Names, separated by commas. Defaults to all that are installed.", metavar="NAMES")
    ] = None,
    points: Annotated[
        str, typer.Option(help="Numbers of points of each cloud, separated by commas.")
    ] = "1000,2000,5000,10000,20000",
    threads: Annotated[str | None, typer.Option(help="Numbers of threads. Defaults to the cores at hand.")] = None,
    blur: Annotated[float, typer.Option(help="Entropic blur, length units.")] = 2e-3,
    device: Annotated[str, typer.Option(help="cpu or cuda.", metavar="NAME")] = "cpu",
    steps: Annotated[int, typer.Option(help="Warm calls, after each of which the points move by 1e-3 RMS.")] = 10,
    repeat: Annotated[int, typer.Option(help="Cold solutions timed; the median counts.")] = 1,
    exact_points: Annotated[int, typer.Option(help="Compare values with the exact cost up to this many points.")] = 2000,
    timeout: Annotated[float, typer.Option(help="Seconds after which a combination is given up.")] = 600.0,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print one JSON object as the last line: rows, machine, versions, settings.")
    ] = False,
) -> None:
    """Measure time, accuracy and memory of cold and warm solutions, on a board of clay with a dent.

    A combination that cannot run is a row with its reason.

    Exit code 0: measured; 1: no combination could run; 2: unusable input.
    """
    from cpdeform.core.machine import available_cores
    from cpdeform.core.plugins import load_registry
    from cpdeform.experiments.bench_ot import OTBenchSettings, bench_ot, default_solvers

    check_device(device)
    registry = load_registry()
    with contextlib.redirect_stdout(sys.stderr):
        # Some solvers' libraries greet on stdout when they are imported.
        names = tuple(split_names(solvers, "--solvers")) if solvers is not None else default_solvers(registry)
    settings = OTBenchSettings(
        solvers=names,
        points=split_numbers(points, "--points"),
        threads=split_numbers(threads, "--threads") if threads is not None else (available_cores(),),
        blur=blur,
        device=device,
        steps=steps,
        repeat=repeat,
        exact_points=exact_points,
        timeout=timeout,
    )
    rows = list(told(bench_ot(settings, registry=registry), count=len(settings.combinations())))
    report(rows, dataclasses.asdict(settings), registry, OT_COLUMNS, OT_NOTE, device=device, as_json=as_json)
