"""The paper's experiments: tasks, methods and seeds, a run record each, and a table of them all.

An experiment's directory is that of a sweep, too: its runs are jobs, which this process does one after the other, since a simulator
uses every core, or the workers of an engine. A record that is there already and belongs to the same task and configuration is read
instead of made again, so that an experiment that was broken off goes on where it was, and several commands may share one.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import AbstractContextManager
from pathlib import Path

from cpdeform.core.errors import EngineError, InputError
from cpdeform.experiments.experiment_job import do_experiment_run, experiment_jobs
from cpdeform.experiments.experiment_plan import METHODS, TASKS, ExperimentSettings, PlannedRun
from cpdeform.experiments.experiment_row import ExperimentRow, read_row
from cpdeform.planning.result import Observer
from cpdeform.run.record_files import environment
from cpdeform.sweep.claim import claimant
from cpdeform.sweep.engine import Engine
from cpdeform.sweep.job import Job
from cpdeform.sweep.queue import CLAIMS, FAILED, SWEEP_FILE, Queue, SweepHead
from cpdeform.sweep.worker import Outcome, Worker, WorkSettings, return_lost

Observe = Callable[[PlannedRun], AbstractContextManager[Sequence[Observer]]]
"""Gives the observers of a run, for as long as it goes on."""

RECORD_PATTERN = re.compile(rf"({'|'.join(map(re.escape, METHODS))})-seed(\d+)")


def run_experiment(
    settings: ExperimentSettings,
    runs: Sequence[PlannedRun],
    *,
    resume: bool = True,
    observe: Observe | None = None,
    engine: Engine | None = None,
    threads: int | None = None,
) -> Iterator[ExperimentRow]:
    """Make every run of an experiment, or read it where it was made before.

    Args:
        settings: What to run.
        runs: Runs of `planned_runs`, in their order.
        resume: Read finished records with the same task and configuration instead of running again.
        observe: Gives observers of a run, beside its record; without an engine.
        engine: Where to run; defaults to this process, one run after the other.
        threads: Threads of each run; defaults to those that this process may use.

    Returns:
        A row for each run, as it is ready. A run that cannot be made is a row with the reason.

    Raises:
        InputError: Another command is at one of the runs, with other settings.
        EngineError: The workers ended before a run was over.
    """
    jobs = experiment_jobs(settings, runs, resume=resume)
    queue = _queue(settings.out, [job for job, _ in jobs], threads=threads)
    planned = {job.name: run for job, run in jobs}
    work = WorkSettings(only=tuple(planned))
    if engine is None:
        watched = _watched(planned, observe) if observe else None
        outcomes = Worker(queue, work, function=do_experiment_run, observe=watched).work()
    else:
        outcomes = engine.work(queue, work)
    left = dict(planned)
    for outcome in outcomes:
        yield _row(left.pop(outcome.name), outcome, settings)
    for name, run in left.items():
        # Another command has done it meanwhile, or nobody has, where the workers were killed.
        content = next((content for _, content in queue.outcomes([name])), None)
        if content is None:
            raise EngineError(f"the workers ended before {name} was over. The same command goes on where they were.")
        yield _row(run, Outcome(name=name, outcome=content.pop("outcome"), figures=content | {"reused": True}), settings)


def _queue(out: Path, jobs: Sequence[Job], *, threads: int | None) -> Queue:
    """The queue with these jobs to be done, whatever became of them before."""
    if (out / SWEEP_FILE).exists():
        there = Queue(out)
        return_lost(there, WorkSettings())
        for job in jobs:
            busy = there.file(CLAIMS, job.name).exists() and claimant(there.file(CLAIMS, job.name)) is not None
            if busy and there.job(job.name).content() != job.content():
                raise InputError(
                    "--out",
                    came=f"{out}, where another command is at {job.record}",
                    expected="the same options as that one's",
                    remedy="Wait for it or stop it, or choose another directory.",
                )
    head = SweepHead(kind="experiment", threads=threads, environment=environment())
    queue = Queue.create(out, head, jobs, replace=True)
    for job in jobs:
        if not queue.file(CLAIMS, job.name).exists():
            queue.forget(job.name)
    return queue


def _watched(planned: dict[str, PlannedRun], observe: Observe) -> Callable[[Job], AbstractContextManager[Sequence[Observer]]]:
    return lambda job: observe(planned[job.name])


def _row(run: PlannedRun, outcome: Outcome, settings: ExperimentSettings) -> ExperimentRow:
    """The row of a run that is over."""
    reason = outcome.figures.get("reason")
    if outcome.outcome == FAILED and reason is not None:
        return ExperimentRow(task=run.task, method=run.method, seed=run.seed, status="failed", reason=str(reason))
    reused = bool(outcome.figures.get("reused"))
    return read_row(run, paper_metric=settings.paper_metric, shape=settings.shape, reused=reused)


def recorded_runs(
    out: Path,
    *,
    tasks: Collection[str] | None = None,
    methods: Collection[str] | None = None,
    seeds: Collection[int] | None = None,
) -> list[PlannedRun]:
    """The runs that a directory holds, whatever experiments they come from: by task in the order of `TASKS`, method, seed.

    Args:
        out: Directory of the records.
        tasks: Names of the tasks to look for, with a variant or without; defaults to all.
        methods: Names of the methods; defaults to all.
        seeds: Seeds; defaults to all.

    Raises:
        InputError: There is no such directory, or no run in it.
    """
    runs = []
    for directory in sorted(out.glob("*/*")):
        match = RECORD_PATTERN.fullmatch(directory.name)
        if match is None or not directory.is_dir():
            continue
        task, method, seed = directory.parent.name, match[1], int(match[2])
        if tasks is None or task in tasks or family(task) in tasks:
            run = PlannedRun(task=task, source=task, method=method, seed=seed, directory=directory)
            if (methods is None or method in methods) and (seeds is None or seed in seeds):
                runs.append(run)
    if not runs:
        raise InputError(
            "--out", came=f"{out}, without a run of that kind", expected="a directory that an experiment was written to"
        )
    return sorted(runs, key=_order)


def family(task: str) -> str:
    """A task's name without its variant: ``"move"`` of ``"move-v3"``."""
    return re.sub(r"-v\d+$", "", task)


def _order(run: PlannedRun) -> tuple[int, str, int, int]:
    known = [name for names in TASKS.values() for name in names]
    place = known.index(family(run.task)) if family(run.task) in known else len(known)
    return place, run.task, list(METHODS).index(run.method), run.seed
