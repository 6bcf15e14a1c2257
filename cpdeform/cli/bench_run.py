"""`cpdeform bench run`: whole runs, end to end."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Annotated

import typer

from cpdeform.cli.bench_output import check_device, report, split_names, split_numbers, told

COLUMNS: Mapping[str, tuple[str, str]] = {
    "backend": ("backend", ""),
    "solver": ("solver", ""),
    "seed": ("seed", "d"),
    "loss_initial": ("loss before", ".4g"),
    "loss_final": ("after", ".4g"),
    "loss_ratio": ("ratio", ".3f"),
    "gradient_evaluations": ("evaluations", "d"),
    "seconds": ("seconds", ".1f"),
    "transport_seconds": ("transport s", ".1f"),
    "rollout_ms_per_iteration": ("rollout ms", ".0f"),
    "objective_ms_per_iteration": ("objective ms", ".0f"),
    "vjp_ms_per_iteration": ("vjp ms", ".0f"),
    "peak_memory_mb": ("peak MB", ".0f"),
}
"""Title and format of each column."""

NOTE = (
    "Seconds: the run without imports; transport: the stages' priorities; rollout, objective and vjp: means over the iterations, "
    "all worlds together. MB are 1e6 bytes."
)


def bench_run_command(
    task: Annotated[str, typer.Argument(help="Name, e.g. writer-v2, or a YAML file.")] = "writer",
    backends: Annotated[str, typer.Option(help="Simulators, separated by commas.", metavar="NAMES")] = "auto",
    solvers: Annotated[str, typer.Option(help="Transport solvers, separated by commas.", metavar="NAMES")] = "auto",
    seeds: Annotated[str, typer.Option(help="Seeds, separated by commas.")] = "0",
    threads: Annotated[int | None, typer.Option(help="Threads. Defaults to the cores at hand.")] = None,
    device: Annotated[str, typer.Option(help="cpu or cuda.", metavar="NAME")] = "cpu",
    iterations: Annotated[int, typer.Option(help="Largest number of gradient steps per stage.")] = 30,
    stages: Annotated[int | None, typer.Option(help="Number of stages. Defaults to the task's.")] = None,
    timeout: Annotated[float, typer.Option(help="Seconds after which a run is given up.")] = 3600.0,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object as the last line.")] = False,
) -> None:
    """Run a task with every combination of simulators, transport solvers and seeds, and say what it cost and what it reached.

    Exit code 0: measured; 1: no combination could run; 2: unusable input.
    """
    from cpdeform.core.machine import available_cores
    from cpdeform.core.plugins import load_registry
    from cpdeform.core.task import load_task
    from cpdeform.experiments.bench_run import RunBenchSettings, bench_run

    check_device(device)
    registry = load_registry()
    load_task(task, registry=registry)
    settings = RunBenchSettings(
        task=task,
        backends=tuple(split_names(backends, "--backends")),
        solvers=tuple(split_names(solvers, "--solvers")),
        seeds=split_numbers(seeds, "--seeds"),
        threads=available_cores() if threads is None else threads,
        device=device,
        iterations=iterations,
        stages=stages,
        timeout=timeout,
    )
    count = len(settings.backends) * len(settings.solvers) * len(settings.seeds)
    rows = list(told(bench_run(settings, registry=registry), count=count))
    report(rows, dataclasses.asdict(settings), registry, COLUMNS, NOTE, device=device, as_json=as_json)
