"""`cpdeform sweep`: many runs in a directory, by as many workers as there are."""

from __future__ import annotations

import dataclasses
import json
import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cpdeform.cli.interruption import exit_code
from cpdeform.cli.sweep_new import new_command

if TYPE_CHECKING:
    from cpdeform.sweep.engine import Engine
    from cpdeform.sweep.queue import Queue
    from cpdeform.sweep.status import SweepStatus, Throughput
    from cpdeform.sweep.worker import Outcome, WorkSettings

ESTIMATE_PLANS, ESTIMATE_CORES = 10_000, 256
"""What `cpdeform sweep table` estimates: so many plans on so many cores."""

sweep = typer.Typer(help="Many runs as jobs in a directory, done by any number of workers.", no_args_is_help=True)
sweep.command("new")(new_command)

Directory = Annotated[Path, typer.Argument(help="Directory of the sweep.", metavar="DIR")]


@sweep.command("work")
def work_command(
    directory: Directory,
    workers: Annotated[
        int | None, typer.Option(help="Workers at the same time. Defaults to as many as there is room for.", metavar="N")
    ] = None,
    shard: Annotated[
        str | None, typer.Option(help="Do only part i of n of the jobs, i from 0: for arrays of jobs.", metavar="I/N")
    ] = None,
    engine: Annotated[str, typer.Option(help="Where workers run: local, ray or slurm.", metavar="NAME")] = "local",
    address: Annotated[str | None, typer.Option(help="(ray) Address of the cluster.", metavar="HOST:PORT")] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", help="Any other option of the engine, e.g. memory_gb=4; repeatable.", metavar="KEY=VALUE"),
    ] = None,
    stale_after: Annotated[
        float, typer.Option(help="A worker without a heartbeat for this long counts as dead.", metavar="SECONDS")
    ] = 60.0,
    attempts: Annotated[int, typer.Option(help="Workers that may die on a job before it counts as failed.", metavar="N")] = 5,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object as the last line.")] = False,
) -> None:
    """Do the jobs of a sweep until none is left; any number of these commands may work on the same directory.

    The job of a worker that dies goes back into the queue. The result of a job does not depend on the worker.

    Exit code 0: all jobs are over and one is done; 1: none is done; 2: unusable input; 130, 143: interrupted (running jobs
    go back into the queue, and continue after their last finished stage).
    """
    from cpdeform.core.plugins import load_registry, split_options
    from cpdeform.sweep.queue import Queue
    from cpdeform.sweep.worker import WorkSettings

    queue = Queue(directory)
    how = WorkSettings(stale_after=stale_after, attempts=attempts, shard=None if shard is None else read_shard(shard))
    options: dict[str, Any] = {**split_options(settings or []), "workers": workers}
    if address is not None:
        options["address"] = address
    work_on(queue, load_registry().create("engine", engine, **options), how)
    _report(queue, as_json=as_json)


@sweep.command("status")
def status_command(
    directory: Directory,
    stale_after: Annotated[
        float, typer.Option(help="A worker without a heartbeat for this long counts as dead.", metavar="SECONDS")
    ] = 60.0,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Print the progress of a sweep, and why jobs failed."""
    from cpdeform.sweep.queue import FAILED, Queue
    from cpdeform.sweep.status import sweep_status

    queue = Queue(directory)
    found = sweep_status(queue, stale_after=stale_after)
    if as_json:
        typer.echo(json.dumps({**dataclasses.asdict(found), "over": found.over}))
        return
    typer.echo(status_line(found))
    for name, content in queue.outcomes(queue.listed(FAILED) if found.failed else ()):
        typer.echo(f"  {name}: {content.get('reason', 'unknown')}")


@sweep.command("table")
def table_command(
    directory: Directory,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Write table.csv, a row for each job that is over, and say how many plans a core makes in an hour."""
    from cpdeform.sweep.queue import Queue

    _report(Queue(directory), as_json=as_json)


@sweep.command("retry")
def retry_command(directory: Directory) -> None:
    """Put failed jobs back into the queue, for `cpdeform sweep work` to do."""
    from cpdeform.sweep.queue import FAILED, Queue

    queue = Queue(directory)
    failed = queue.listed(FAILED)
    for name in failed:
        queue.forget(name)
    typer.echo(f"{len(failed)} jobs are in the queue again")


def read_shard(text: str) -> tuple[int, int]:
    """Read ``i/n``.

    Raises:
        InputError: It is something else.
    """
    from cpdeform.core.errors import InputError

    match = re.fullmatch(r"(\d{1,9})/(\d{1,9})", text.strip())
    if match is None:
        raise InputError("--shard", came=f'"{text}"', expected="i/n with i from 0 to n - 1, such as 0/4")
    return int(match[1]), int(match[2])


def status_line(found: SweepStatus) -> str:
    """How far a sweep is, in a line."""
    parts = [f"{found.done} of {found.jobs} jobs done"]
    counts = {"running": found.running, "with a silent worker": found.silent, "waiting": found.waiting, "failed": found.failed}
    parts += [f"{count} {name}" for name, count in counts.items() if count]
    if found.lost:
        parts.append(f"{found.lost} times a worker died")
    return ", ".join(parts)


def throughput_text(found: Throughput) -> str:
    """What a sweep took, and what more of the same would."""
    rate = found.plans_per_core_hour
    if rate is None:
        return "No job is done yet."
    hours = found.hours_for(ESTIMATE_PLANS, cores=1) or 0.0
    needed = f"{hours:.3g} core-hours, {hours / ESTIMATE_CORES:.2g} hours on {ESTIMATE_CORES} cores"
    return (
        f"{found.plans} plans in {found.core_hours:.3g} core-hours ({found.cpu_hours:.3g} of them computing): "
        f"{rate:.3g} plans per core-hour. "
        f"At this rate {ESTIMATE_PLANS:,} plans take {needed}."
    )


def work_on(queue: Queue, engine: Engine, settings: WorkSettings) -> None:
    """Let an engine work, a line on stderr for each job."""
    from cpdeform.sweep.status import sweep_status

    found = sweep_status(queue, stale_after=settings.stale_after)
    over = found.done + found.failed
    try:
        for outcome in engine.work(queue, settings):
            over += 1
            typer.echo(f"{over}/{found.jobs}  {_outcome_line(outcome)}", err=True)
    except KeyboardInterrupt as error:
        left = status_line(sweep_status(queue, stale_after=settings.stale_after))
        typer.echo(f"cpdeform: interrupted; {left}; the same command goes on from here", err=True)
        raise typer.Exit(exit_code(error)) from error


def _outcome_line(outcome: Outcome) -> str:
    figures = outcome.figures
    if outcome.outcome == "failed":
        return f"{outcome.name}: failed; {figures.get('reason', 'unknown')}"
    losses = [figures.get(name) for name in ("loss_initial", "loss_final")]
    text = ", loss " + " -> ".join(f"{value:.4g}" for value in losses if value is not None) if any(losses) else ""
    return f"{outcome.name}: {figures.get('status', 'done')}{text}, {figures.get('seconds', 0.0):.1f} s"


def _report(queue: Queue, *, as_json: bool) -> None:
    """Write the table and say what the sweep took; exit code 1 where nothing is done."""
    from cpdeform.sweep.status import TABLE_FILE, sweep_status, write_sweep_table

    rows, found = write_sweep_table(queue)
    status = sweep_status(queue)
    if as_json:
        took = {**dataclasses.asdict(found), "plans_per_core_hour": found.plans_per_core_hour}
        typer.echo(json.dumps({"status": dataclasses.asdict(status), "throughput": took, "rows": rows}, default=str))
    else:
        typer.echo(f"{status_line(status)}\n{throughput_text(found)}\nwritten to {queue.directory / TABLE_FILE}")
    if not status.done:
        raise typer.Exit(1)
