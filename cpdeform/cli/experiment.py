"""`cpdeform experiment`: the paper's experiments, each a table of runs."""

from __future__ import annotations

import contextlib
import dataclasses
import enum
import json
import shlex
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cpdeform.cli.bench_output import check_device, print_markdown, split_names, split_numbers
from cpdeform.cli.interruption import exit_code
from cpdeform.core.errors import InputError

if TYPE_CHECKING:
    from cpdeform.core.plugins import Registry
    from cpdeform.experiments.experiment_plan import ExperimentSettings, PlannedRun
    from cpdeform.experiments.experiment_row import ExperimentRow
    from cpdeform.planning.result import Observer
    from cpdeform.sweep.engine import Engine


class ExperimentName(enum.StrEnum):
    """The experiments of the paper."""

    MULTI_STAGE = "multi-stage"
    SINGLE_STAGE = "single-stage"
    SEARCH = "search"
    ABLATION = "ablation"
    RUNTIME = "runtime"
    LANDSCAPE = "landscape"
    RIVALS = "rivals"


def experiment(
    name: Annotated[
        ExperimentName,
        typer.Argument(
            help="multi-stage: judged by W1 to the goal; single-stage: by the normalised incremental IoU; search, ablation, "
            "runtime, landscape, rivals: see docs/experiments.md.",
            metavar="NAME",
        ),
    ],
    tasks: Annotated[
        str | None,
        typer.Option(help="Names or YAML files, separated by commas. Defaults to all of the experiment.", metavar="NAMES"),
    ] = None,
    variants: Annotated[
        str | None,
        typer.Option(help="(single-stage) Variants of tasks named without one. Defaults to v1,v2,v3.", metavar="NAMES"),
    ] = None,
    methods: Annotated[
        str | None,
        typer.Option(
            help="Of cpdeform, tuned, sculpt, paper, fixed, random, restarts, bayesopt, cma, mppi, sampled-gradients, sac, ppo and "
            "td3, separated by commas. Defaults to cpdeform,fixed, or those of the experiment.",
            metavar="NAMES",
        ),
    ] = None,
    seeds: Annotated[str | None, typer.Option(help="Seeds, separated by commas. Defaults to 0.", metavar="NUMBERS")] = None,
    iterations: Annotated[
        int | None, typer.Option(help="Largest number of gradient steps per stage. Defaults to the task's, or 40.")
    ] = None,
    stages: Annotated[int | None, typer.Option(help="Number of stages. Defaults to the task's.")] = None,
    particles: Annotated[
        int | None, typer.Option(help="Particles of all bodies together; goals stay as they are. Defaults to the task's.")
    ] = None,
    goals: Annotated[
        Path | None, typer.Option(help="Directory with a goal <task>.npz for every task, instead of their own.", metavar="DIR")
    ] = None,
    backend: Annotated[
        str | None, typer.Option(help="Simulator; auto: the fastest installed. Defaults to auto.", metavar="NAME")
    ] = None,
    ot: Annotated[str | None, typer.Option(help="Optimal-transport solver. Defaults to auto.", metavar="NAME")] = None,
    device: Annotated[str | None, typer.Option(help="cpu or cuda. Defaults to cpu.", metavar="NAME")] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", help="Any other option of `cpdeform run`, for all runs; repeatable.", metavar="KEY=VALUE"),
    ] = None,
    equal_evaluations: Annotated[
        bool, typer.Option("--equal-evaluations", help="Give fixed as many gradient evaluations per stage as cpdeform used.")
    ] = False,
    paper_metric: Annotated[bool, typer.Option("--paper-metric", help="Also take W1 with the paper's settings.")] = False,
    shape: Annotated[bool, typer.Option("--shape", help="Also take the shape figures, from rest to rest.")] = False,
    preset: Annotated[
        str | None,
        typer.Option(
            help="quick: small, for a look; standard: three stages, three seeds; paper: the tasks as they are, five seeds. Other "
            "options override it.",
            metavar="NAME",
        ),
    ] = None,
    size: Annotated[int | None, typer.Option(help="(landscape) Starts along x and along z. Defaults to 20.")] = None,
    out: Annotated[
        Path | None, typer.Option(help="Directory of records and tables. Defaults to experiments/<experiment>.", metavar="DIR")
    ] = None,
    resume: Annotated[
        bool,
        typer.Option("--resume/--no-resume", help="Read recorded runs of the same configuration instead of running them again."),
    ] = True,
    no_run: Annotated[
        bool, typer.Option("--no-run", help="Run nothing; make the tables of all records in --out, or of the chosen ones.")
    ] = False,
    workers: Annotated[
        int | None,
        typer.Option(
            help="Runs at the same time, each with its share of the cores. Defaults to one run with all cores.", metavar="N"
        ),
    ] = None,
    engine: Annotated[
        str | None, typer.Option(help="Where they run: local, ray or slurm. Defaults to this process.", metavar="NAME")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object as the last line.")] = False,
) -> None:
    """Run one of the paper's experiments, with a record of each run and a table of all.

    A task's name with a variant, such as move-v4, or a YAML file is run as it is.

    Exit code 0: there are figures; 1: no run has any; 2: unusable input; 130: interrupted (the table holds what was done).
    """
    given = with_preset(name.value, locals())
    if name is ExperimentName.LANDSCAPE:
        from cpdeform.cli.landscape import landscape

        landscape({key: value for key, value in given.items() if key != "name"})
        return
    if given.pop("size") is not None:
        raise InputError("--size", came=str(size), expected=f"none with {name.value}", remedy="It is the landscape's.")
    single = name is ExperimentName.SINGLE_STAGE
    if not single and variants is not None:
        raise InputError("--variants", came=variants, expected=f"none with {name.value}", remedy="Name the task with its variant.")
    given["variants"] = variants or "v1,v2,v3" if single else ""
    _command(given.pop("name").value, given)


def with_preset(name: str, given: dict[str, Any]) -> dict[str, Any]:
    """The options with what the preset says where none were given.

    Raises:
        UnknownNameError: There is no such preset.
        InputError: The experiment has none.
    """
    wanted = given.pop("preset")
    if wanted is None:
        return given
    from cpdeform.experiments.studies.study import preset

    if name in (ExperimentName.MULTI_STAGE, ExperimentName.SINGLE_STAGE):
        raise InputError("--preset", came=f"{wanted} with {name}", expected="none", remedy="The further experiments have presets.")
    return given | {key: value for key, value in preset(wanted, experiment=name).items() if given[key] is None}


def _command(name: str, given: dict[str, Any]) -> None:
    """Run an experiment, or only make its tables, and print the outcome."""
    as_json, no_run, resume = (given.pop(key) for key in ("as_json", "no_run", "resume"))
    where = {key: given.pop(key) for key in ("engine", "workers")}
    given["out"] = given["out"] or Path("experiments") / name
    rows: list[ExperimentRow] = []
    with contextlib.redirect_stdout(sys.stderr):
        # Some backends greet on stdout when they are imported.
        source, planned, settings = _recorded(name, given) if no_run else _run(name, given, where, resume=resume)
        if no_run:
            rows.extend(source)
            _write(name, rows, given["out"], planned=planned)
        else:
            _collect(name, rows, source, given["out"], planned=planned)
    _report(name, rows, settings, given["out"], as_json=as_json)


def _collect(name: str, rows: list[ExperimentRow], source: Iterator[ExperimentRow], out: Path, *, planned: int) -> None:
    """Take rows as they come; the tables are written after each."""
    try:
        for row in source:
            rows.append(row)
            _write(name, rows, out, planned=planned)
            typer.echo(f"{len(rows)}/{planned}  {_row_line(row)}", err=True)
    except KeyboardInterrupt as error:
        left = f"{out / 'table.md'} holds the {len(rows)} runs that are done" if rows else "no run was done"
        typer.echo(f"cpdeform: interrupted; {left}; the same command goes on from here", err=True)
        raise typer.Exit(exit_code(error)) from error


def _write(name: str, rows: Sequence[ExperimentRow], out: Path, *, planned: int) -> None:
    """Write the tables, and the summary of a study."""
    from cpdeform.experiments.experiment_tables import sorted_rows, write_tables
    from cpdeform.experiments.studies.study import STUDIES

    write_tables(name, rows, out, planned=planned)
    if name in STUDIES:
        from cpdeform.experiments.studies.report import write_study

        write_study(name, sorted_rows(rows), out, planned=planned)


def _recorded(name: str, given: dict[str, Any]) -> tuple[Iterator[ExperimentRow], int, dict[str, Any]]:
    """Rows of the records that are there."""
    from cpdeform.experiments.experiment import recorded_runs
    from cpdeform.experiments.experiment_row import read_row

    tasks, methods, seeds = given["tasks"], given["methods"], given["seeds"]
    runs = recorded_runs(
        given["out"],
        tasks=None if tasks is None else [Path(task).stem for task in split_names(tasks, "--tasks")],
        methods=None if methods is None else split_names(methods, "--methods"),
        seeds=None if seeds is None else split_numbers(seeds, "--seeds"),
    )
    rows = (read_row(run, paper_metric=given["paper_metric"], shape=given["shape"], reused=True) for run in runs)
    return rows, len(runs), {"out": str(given["out"])}


def _run(
    name: str, given: dict[str, Any], where: dict[str, Any], *, resume: bool
) -> tuple[Iterator[ExperimentRow], int, dict[str, Any]]:
    """Rows of runs that are made, or read where they are recorded."""
    from cpdeform.core.machine import machine_cores
    from cpdeform.core.plugins import load_registry
    from cpdeform.experiments.experiment import run_experiment
    from cpdeform.experiments.experiment_plan import planned_runs
    from cpdeform.experiments.experiment_row import without_directories
    from cpdeform.run.record_files import check_directory

    registry = load_registry()
    settings = _settings(name, given, registry)
    check_directory(settings.out, overwrite=True)
    runs = planned_runs(settings, registry=registry)
    command = without_directories(shlex.join(_command_line(name, given)))
    session = _Session(settings, command, registry)
    if where["engine"] is None and where["workers"] in (None, 1):
        rows = run_experiment(settings, runs, resume=resume, observe=_observer(settings, session))
        return rows, len(runs), dataclasses.asdict(settings)
    engine: Engine = registry.create("engine", where["engine"] or "local", workers=where["workers"])
    threads = max(1, machine_cores() // (where["workers"] or 1))
    rows = run_experiment(settings, runs, resume=resume, engine=engine, threads=threads)
    return session.noted(rows), len(runs), dataclasses.asdict(settings)


def _settings(name: str, given: dict[str, Any], registry: Registry) -> ExperimentSettings:
    from cpdeform.core.plugins import split_options
    from cpdeform.experiments.experiment_plan import TASKS, ExperimentSettings, expand_tasks
    from cpdeform.experiments.studies.study import STUDIES

    values = {key: value for key, value in given.items() if value is not None}
    study = STUDIES.get(name)
    names = split_names(values.pop("tasks"), "--tasks") if "tasks" in values else study.tasks if study else TASKS[name]
    if study is not None:
        values = {"methods": ",".join(study.methods), "equal_cost": study.equal_cost, **values}
    variants = values.pop("variants")
    tasks = expand_tasks(names, split_names(variants, "--variants") if variants else (), registry=registry)
    if "device" in values:
        check_device(values["device"])
    if "methods" in values:
        values["methods"] = tuple(split_names(values["methods"], "--methods"))
    if "seeds" in values:
        values["seeds"] = split_numbers(values["seeds"], "--seeds")
    return ExperimentSettings(name=name, tasks=tasks, options=split_options(values.pop("settings", [])), **values)


def _command_line(name: str, given: dict[str, Any]) -> Iterator[str]:
    """The command that was given, with all options that are not the default."""
    yield from ("cpdeform", "experiment", name)
    for key, value in given.items():
        if key == "settings":
            for setting in value or ():
                yield from ("--set", setting)
        elif value is True:
            yield f"--{key.replace('_', '-')}"
        elif value not in (None, False, ""):
            yield from (f"--{key.replace('_', '-')}", str(value))


class _Session:
    """This command, to be noted in the experiment's directory once it has run something."""

    def __init__(self, settings: ExperimentSettings, command: str, registry: Registry) -> None:
        self._settings, self._command, self._registry = settings, command, registry
        self._noted = False

    def note(self) -> None:
        """Note it, once."""
        from cpdeform.experiments.experiment_tables import note_session
        from cpdeform.experiments.tables import describe_machine, describe_versions

        if not self._noted:
            machine = describe_machine(device=self._settings.device or "cpu")
            note_session(self._settings.out, command=self._command, machine=machine, versions=describe_versions(self._registry))
            self._noted = True

    def noted(self, rows: Iterator[ExperimentRow]) -> Iterator[ExperimentRow]:
        """Pass rows on; with the first one that was not found but made, this session is noted."""
        for row in rows:
            if not row.reused:
                self.note()
            yield row


def _observer(
    settings: ExperimentSettings, session: _Session
) -> Callable[[PlannedRun], contextlib.AbstractContextManager[Sequence[Observer]]]:
    """Shows the progress of each run on stderr, from when it starts."""

    @contextlib.contextmanager
    def observe(run: PlannedRun) -> Iterator[Sequence[Observer]]:
        from cpdeform.cli.progress import ProgressBar, ProgressLines, Starting

        def begin() -> None:
            session.note()
            typer.echo(f"{run.task}, {run.method}, seed {run.seed}", err=True)

        if sys.stderr.isatty():
            with ProgressBar(stages=settings.stages) as bar:
                yield [Starting(begin), bar]
        else:
            yield [Starting(begin), ProgressLines()]

    return observe


def _row_line(row: ExperimentRow) -> str:
    from cpdeform.experiments.tables import cell

    found = " (found)" if row.reused else ""
    text = f"{row.task}, {row.method}, seed {row.seed}: {row.status.replace('_', ' ')}{found}"
    if row.has_figures:
        figures = f"W1 {cell(row.w1_initial, '.4g')} -> {cell(row.w1_final, '.4g')}, IoU {cell(row.incremental_iou, '.2f')}"
        text += f", {figures}, {row.gradient_evaluations} gradient evaluations, {row.seconds:.0f} s"
    return f"{text}; {row.reason}" if row.reason else text


def _report(name: str, rows: Sequence[ExperimentRow], settings: dict[str, Any], out: Path, *, as_json: bool) -> None:
    """Print the tables, or one JSON object; exit code 1 where no run has figures."""
    from cpdeform.experiments.experiment_tables import TABLE_FILE, paper_figures, read_sessions, sorted_rows
    from cpdeform.experiments.studies.study import STUDIES
    from cpdeform.experiments.studies.summary import SUMMARY_FILE
    from cpdeform.run.record_files import to_json

    if as_json:
        content = {
            "experiment": name,
            "rows": [dataclasses.asdict(row) for row in sorted_rows(rows)],
            "paper": dataclasses.asdict(paper_figures("single-stage" if name == "single-stage" else "multi-stage")),
            "sessions": read_sessions(out),
            "settings": settings,
            "out": str(out),
        }
        typer.echo(json.dumps(to_json(content), default=str))
    else:
        summary = out / SUMMARY_FILE if name in STUDIES else out / TABLE_FILE
        print_markdown(summary.read_text(encoding="utf-8"))
        typer.echo(f"written to {summary}")
    if not any(row.has_figures for row in rows):
        raise typer.Exit(1)
