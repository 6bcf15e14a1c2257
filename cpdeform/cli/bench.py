"""`cpdeform bench`: what parts cost on this machine."""

from __future__ import annotations

import contextlib
import dataclasses
import sys
from collections.abc import Mapping
from typing import Annotated

import typer

from cpdeform.cli.bench_cards import bench_cards_command
from cpdeform.cli.bench_ot import bench_ot_command
from cpdeform.cli.bench_output import check_device, report, split_names, split_numbers, told
from cpdeform.cli.bench_run import bench_run_command

bench = typer.Typer(
    no_args_is_help=True, help="Measure what parts cost on this machine, each measurement in a fresh process; benchmark cards."
)

Json = Annotated[bool, typer.Option("--json", help="Print one JSON object as the last line: rows, machine, versions, settings.")]

bench.command("ot")(bench_ot_command)
bench.command("run")(bench_run_command)
bench.command("cards")(bench_cards_command)

SIMULATOR_COLUMNS: Mapping[str, tuple[str, str]] = {
    "backend": ("backend", ""),
    "dtype": ("type", ""),
    "threads": ("threads", "d"),
    "particles": ("particles", ",d"),
    "worlds": ("worlds", "d"),
    "forward_ms_per_substep": ("forward ms", ".3g"),
    "backward_ms_per_substep": ("backward ms", ".3g"),
    "particle_substeps_per_second": ("particle substeps/s", ".3g"),
    "peak_memory_mb": ("peak MB", ".0f"),
    "rollout_memory_mb": ("rollout MB", ".0f"),
    "memory_estimate_mb": ("estimate MB", ".0f"),
    "first_gradient_seconds": ("first gradient s", ".1f"),
}
"""Title and format of each column."""

SIMULATOR_NOTE = (
    "Times are for one substep of all worlds of the row together, medians. Peak: above the process before the simulator was built; "
    "rollout: a rollout and its gradient, which is what the estimate predicts. MB are 1e6 bytes."
)


@bench.command("simulators")
def bench_simulators_command(
    backends: Annotated[
        str | None, typer.Option(help="Names, separated by commas. Defaults to all that are installed.", metavar="NAMES")
    ] = None,
    particles: Annotated[str, typer.Option(help="Numbers of particles, separated by commas.")] = "1000,10000,100000",
    worlds: Annotated[str, typer.Option(help="Numbers of worlds, separated by commas.")] = "1,4,16",
    threads: Annotated[str | None, typer.Option(help="Numbers of threads. Defaults to the cores at hand.")] = None,
    device: Annotated[str, typer.Option(help="cpu or cuda.", metavar="NAME")] = "cpu",
    dtype: Annotated[str | None, typer.Option(help="float32 or float64. Defaults to each backend's.", metavar="NAME")] = None,
    steps: Annotated[int, typer.Option(help="Environment steps of a rollout.")] = 2,
    repeat: Annotated[int, typer.Option(help="Rollouts and gradients timed; the median counts.")] = 3,
    timeout: Annotated[float, typer.Option(help="Seconds after which a combination is given up.")] = 600.0,
    as_json: Json = False,
) -> None:
    """Measure time and memory of rollouts and gradients, on the clay board of the task writer.

    Times are for one substep of all worlds of a row together. A combination that cannot run is a row with its reason.

    Exit code 0: measured; 1: no combination could run; 2: unusable input.
    """
    from cpdeform.core.machine import available_cores
    from cpdeform.core.plugins import load_registry
    from cpdeform.experiments.bench_simulators import SimulatorBenchSettings, bench_simulators, default_backends

    check_device(device)
    registry = load_registry()
    with contextlib.redirect_stdout(sys.stderr):
        # Some backends greet on stdout when they are imported.
        names = tuple(split_names(backends, "--backends")) if backends is not None else default_backends(registry)
    settings = SimulatorBenchSettings(
        backends=names,
        particles=split_numbers(particles, "--particles"),
        worlds=split_numbers(worlds, "--worlds"),
        threads=split_numbers(threads, "--threads") if threads is not None else (available_cores(),),
        device=device,
        dtype=dtype,
        steps=steps,
        repeat=repeat,
        timeout=timeout,
    )
    rows = list(told(bench_simulators(settings, registry=registry), count=len(settings.combinations())))
    report(rows, dataclasses.asdict(settings), registry, SIMULATOR_COLUMNS, SIMULATOR_NOTE, device=device, as_json=as_json)
