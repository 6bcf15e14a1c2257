"""Compare placers at equal gradient evaluations: `python -m cpdeform.experiments.placers writer --seeds 3 --iterations 30`."""

from __future__ import annotations

import os
import platform
import statistics
from pathlib import Path
from typing import Annotated, Any

import typer

from cpdeform.core.plugins import Registry, load_registry
from cpdeform.experiments.tables import markdown
from cpdeform.planning.result import DeformResult
from cpdeform.run.resolve import resolve

COLUMNS = ("task", "placer", "seed", "status", "loss initial", "loss final", "ratio", "metric", "evaluations", "seconds")


def run_placer(task: str, placer: str, seed: int, *, iterations: int, registry: Registry) -> DeformResult:
    """Run one task with one placer and one seed."""
    options: dict[str, Any] = {"iterations": iterations, "patience": iterations}
    values = {"task": task, "placer": placer, "seed": seed, "optimizer": options}
    return resolve(values, registry=registry).run()


def table_row(placer: str, seed: int, result: DeformResult) -> list[str]:
    """Cells of one run, in the order of `COLUMNS`."""
    ratio = result.loss_final / result.loss_initial
    losses = [f"{result.loss_initial:.6f}", f"{result.loss_final:.6f}", f"{ratio:.3f}", f"{result.metric_value:.3f}"]
    effort = [str(result.gradient_evaluations), f"{result.seconds:.0f}"]
    return [result.task.name, placer, str(seed), result.status.value, *losses, *effort]


def main(
    task: Annotated[str, typer.Argument(help="Task, e.g. writer or writer-v2.")] = "writer",
    placers: Annotated[str, typer.Option(help="Names, separated by commas.")] = "transport,fixed,random",
    seeds: Annotated[int, typer.Option(help="Number of seeds, from 0.", min=1)] = 3,
    iterations: Annotated[int, typer.Option(help="Gradient evaluations of every run.", min=1)] = 30,
    out: Annotated[Path | None, typer.Option(help="Also write the tables to this file.")] = None,
) -> None:
    """Print every run and the means, as Markdown."""
    registry = load_registry()
    rows, means = [], []
    for placer in placers.split(","):
        results = []
        for seed in range(seeds):
            results.append(run_placer(task, placer, seed, iterations=iterations, registry=registry))
            rows.append(table_row(placer, seed, results[-1]))
            typer.echo(" ".join(rows[-1]), err=True)
        ratio = statistics.fmean(result.loss_final / result.loss_initial for result in results)
        metric = statistics.fmean(result.metric_value for result in results)
        means.append([placer, str(seeds), f"{ratio:.3f}", f"{metric:.3f}"])
    machine = f"{platform.machine()}, {os.cpu_count()} cores, {platform.system()}, Python {platform.python_version()}"
    header = ["placer", "seeds", "mean ratio", "mean metric"]
    text = f"{markdown(header, means)}\n\n{markdown(COLUMNS, rows)}\n\n{machine}; {iterations} gradient evaluations a run.\n"
    typer.echo(text)
    if out is not None:
        out.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    typer.run(main)
