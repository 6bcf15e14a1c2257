"""`cpdeform run`: a task to a plan, with its record and pictures."""

from __future__ import annotations

import contextlib
import datetime
import json
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cpdeform.cli.interruption import exit_code
from cpdeform.run.flags import FLAGS

if TYPE_CHECKING:
    from cpdeform.cli.progress import Progress
    from cpdeform.core.plugins import Registry
    from cpdeform.planning.result import DeformResult
    from cpdeform.run.estimate import RunEstimate
    from cpdeform.run.record import RunRecorder
    from cpdeform.run.resolve import ResolvedRun

SOURCE = "--set"

KINDS = {"backend": "simulator", "ot": "ot_solver", "placer": "placer", "strategy": "strategy"}
"""What the names that flags give are registered as."""

REPLACED = {
    "algorithm": ("a strategy", "Use --strategy paper for Algorithm 1 to the letter, --strategy cpdeform for the default."),
    "optimizer.schedule": ("a pruner", "Use --set optimizer.pruner=halving, or none for all iterations of every candidate."),
}
"""Settings of earlier versions: what has taken their place, and how to ask for it."""


def run(
    task: Annotated[str | None, typer.Argument(help="Name of a task, e.g. writer-v2, or a YAML file. Defaults to writer.")] = None,
    backend: Annotated[
        str | None, typer.Option(help="Simulator; auto: the fastest installed. Defaults to auto.", metavar="NAME")
    ] = None,
    ot: Annotated[str | None, typer.Option(help="Optimal-transport solver. Defaults to auto.", metavar="NAME")] = None,
    placer: Annotated[
        str | None, typer.Option(help="Where tools are put. Defaults to what the strategy takes.", metavar="NAME")
    ] = None,
    strategy: Annotated[
        str | None,
        typer.Option(help="How to search, see `cpdeform strategies`. Defaults to auto: what fits the task.", metavar="NAME"),
    ] = None,
    device: Annotated[str | None, typer.Option(help="cpu or cuda. Defaults to cpu.", metavar="NAME")] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of first actions and random placements. Defaults to 0.")] = None,
    stages: Annotated[int | None, typer.Option(help="Number of stages. Defaults to the task's.")] = None,
    steps: Annotated[int | None, typer.Option(help="Environment steps of a stage. Defaults to the task's.")] = None,
    goal: Annotated[
        Path | None, typer.Option(help="Goal file instead of the task's own, see `cpdeform task import-grid`.", metavar="FILE")
    ] = None,
    iterations: Annotated[
        int | None,
        typer.Option(help="Largest number of gradient steps per stage, not of touches. Defaults to what fits the task."),
    ] = None,
    workers: Annotated[
        int | None, typer.Option(help="Processes that the candidates of a stage are spread over. Defaults to 1.", metavar="N")
    ] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", help="Any other option, e.g. optimizer.learning_rate=0.05; repeatable.", metavar="KEY=VALUE"),
    ] = None,
    resume: Annotated[
        Path | None,
        typer.Option(
            help="Continue this run record: its last state and its task. Options given here override the recorded ones.",
            metavar="DIR",
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Directory of the run record. Defaults to runs/<task>-<time>.", metavar="DIR")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the run record in --out.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object as the last line, no progress.")] = False,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Run nothing; print the full configuration, defaults included, as YAML or JSON.")
    ] = False,
    no_pictures: Annotated[bool, typer.Option("--no-pictures", help="Draw no picture and no animation.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Print nothing but errors.")] = False,
) -> None:
    """Plan how the tools of a task turn its body into its goal, and record the run.

    With --resume, TASK may be left out, and --stages counts further stages (those left of the recorded run, or else one).

    Exit code 0: a plan was found; 1: none was (the advice says what to try); 2: unusable input; 130, 143, 129: interrupted
    by control-C, SIGTERM, SIGHUP.
    """
    flags = (task, backend, ot, placer, strategy, device, seed, stages, steps, goal, workers, iterations)
    given = {field: value for field, value in zip(FLAGS, flags, strict=True) if value is not None}
    resolved = resolve_command(given, settings or [], resume=resume, out=out)
    if dry_run:
        _print_configuration(resolved, as_json=as_json)
        if not quiet:
            _print_estimate(resolved)
        return
    with contextlib.redirect_stdout(sys.stderr) if as_json else contextlib.nullcontext():
        # Libraries print to stdout, too; a reader of the JSON must not see that.
        result, directory = _execute(resolved, out, overwrite=overwrite, silent=as_json or quiet)
        if not (no_pictures or as_json or quiet):
            typer.echo("drawing the picture and the animation (up to two minutes; --no-pictures leaves them out)", err=True)
        picture = None if no_pictures else _draw(directory)
    if as_json:
        typer.echo(json.dumps(_summary(result, resolved, directory, resumed_from=resume)))
    elif not quiet:
        _print_summary(result, directory, picture, resumed_from=resume, first_stage=resolved.first_stage)
    if not _finished(result):
        raise typer.Exit(1)


def resolve_command(
    given: dict[str, Any], settings: list[str], *, resume: Path | None = None, out: Path | None = None
) -> ResolvedRun:
    """The run that a command line asks for.

    Args:
        given: Values of the flags, by the field of `FLAGS`.
        settings: Values of ``--set``; flags override them.
        resume: Record to go on from.
        out: Directory of the new record.

    Raises:
        InputError: Something of it cannot be used; the message names the flag.
    """
    from cpdeform.core.errors import InputError
    from cpdeform.core.plugins import load_registry, split_options

    registry, values = load_registry(), split_options(settings)
    _check_replaced(values)
    _check_names(given, registry, resumed=resume is not None)
    # What follows takes seconds to import; a typo is answered before.
    from cpdeform.core.task import merge, validate
    from cpdeform.run.configuration import RunConfiguration
    from cpdeform.run.record_reader import load_record
    from cpdeform.run.resolve import resolve

    if resume is not None and out is not None and out.resolve() == resume.resolve():
        raise InputError("--out", came="the directory of --resume", expected="another one, for the record of the stages to come")
    for field, value in given.items():
        group, dot, name = field.rpartition(".")
        if dot and not isinstance(values.get(group, {}), dict):
            continue
        values = merge(values, {group: {name: value}} if dot else {field: value})
    try:
        validate(RunConfiguration, values, source=SOURCE)
    except InputError as error:
        field = error.argument.removeprefix(f"{SOURCE}: ")
        if field in given:
            raise InputError(FLAGS[field], came=error.came, expected=error.expected, remedy=error.remedy) from error
        raise
    return resolve(values, registry=registry, record=None if resume is None else load_record(resume))


def _check_replaced(values: dict[str, Any]) -> None:
    """Raise `InputError` for settings that have another name now."""
    from cpdeform.core.errors import InputError

    for name, (expected, remedy) in REPLACED.items():
        group, _, field = name.rpartition(".")
        options = values.get(group, {}) if group else values
        if isinstance(options, dict) and field in options:
            raise InputError("--set", came=f'"{name}={options[field]}"', expected=expected, remedy=remedy)


def _check_names(given: dict[str, Any], registry: Registry, *, resumed: bool) -> None:
    """Raise an error for names that nothing is registered under, and for a task that cannot be read."""
    from cpdeform.core.plugins import AUTO
    from cpdeform.core.task import load_task

    for field, kind in KINDS.items():
        if given.get(field, AUTO) != AUTO:
            registry.find(kind, given[field])
    if "task" in given and not resumed:
        load_task(given["task"], registry=registry)


def _execute(resolved: ResolvedRun, out: Path | None, *, overwrite: bool, silent: bool) -> tuple[DeformResult, Path]:
    """Run with record and progress; the cheap checks come first, and nothing is written before all are passed."""
    from cpdeform.run.record import RunRecorder

    configuration = resolved.configuration
    resolved.task.load_goal()
    recorder = RunRecorder(
        out or _default_directory(resolved.task.name),
        configuration=configuration,
        overwrite=overwrite,
        resumed_from=resolved.record,
        origins=resolved.origins,
    )
    try:
        with recorder, _progress(configuration.stages, resolved.first_stage, silent=silent) as observers:
            result = resolved.run([recorder, *observers], on_estimate=_teller(observers, resolved))
    except KeyboardInterrupt as error:
        typer.echo(_interruption(recorder), err=True)
        raise typer.Exit(exit_code(error)) from error
    return result, recorder.directory


def _print_configuration(resolved: ResolvedRun, *, as_json: bool) -> None:
    """Print all names and values of a run, and its task in full."""
    import yaml

    content = {
        "configuration": resolved.configuration.model_dump(mode="json"),
        "first_stage": resolved.first_stage,
        "task": resolved.task.model_dump(mode="json"),
    }
    typer.echo(json.dumps(content) if as_json else yaml.safe_dump(content, sort_keys=False).rstrip())


def _print_estimate(resolved: ResolvedRun) -> None:
    """Print on stderr what a run would take; a rollout is measured for it."""
    from cpdeform.cli.progress import estimate_line

    try:
        line = estimate_line(resolved.estimate(resolved.planner()))
    except Exception as error:
        line = f"no estimate: {error}"
    typer.echo(line, err=True)


def _teller(observers: list[Progress], resolved: ResolvedRun) -> Callable[[RunEstimate | None], None] | None:
    """What tells the observers of the estimate; None where there are none, so that nothing is measured."""
    stages = resolved.configuration.stages or resolved.task.stage_count

    def tell(estimate: RunEstimate | None) -> None:
        for observer in observers:
            observer.estimated(estimate, stages=stages)

    return tell if observers else None


def _interruption(recorder: RunRecorder) -> str:
    if not recorder.started:
        return "cpdeform: interrupted before the run began; nothing was written"
    text = f"cpdeform: interrupted; the finished stages are recorded in {recorder.directory}"
    if recorder.rescued:
        text += ", and so is the best plan so far of the stage that was interrupted"
    return f"{text}; go on with: cpdeform run --resume {recorder.directory}" if recorder.stages else text


def _default_directory(task: str) -> Path:
    """A directory under ``runs`` that does not exist yet."""
    stamp = datetime.datetime.now().strftime("%Y%m%d-%H%M%S")
    first = Path("runs") / f"{task}-{stamp}"
    path, number = first, 1
    while path.exists():
        number += 1
        path = first.with_name(f"{first.name}-{number}")
    return path


@contextlib.contextmanager
def _progress(stages: int | None, first_stage: int, *, silent: bool) -> Iterator[list[Progress]]:
    """Observers that show the progress: none, a bar on a terminal, else lines."""
    from cpdeform.cli.progress import ProgressBar, ProgressLines

    if silent:
        yield []
    elif sys.stderr.isatty():
        with ProgressBar(stages=stages, first_stage=first_stage) as bar:
            yield [bar]
    else:
        yield [ProgressLines()]


def _draw(directory: Path) -> Path | None:
    """Draw the pictures; the run is recorded, so that whatever goes wrong here is told and does not fail the command."""
    try:
        from cpdeform.report import draw_run

        return draw_run(directory)
    except ModuleNotFoundError as error:
        typer.echo(f'cpdeform: no pictures: {error.name} is missing; pip install "cpdeform[report]"', err=True)
    except Exception as error:
        typer.echo(f"cpdeform: no pictures: {type(error).__name__}: {error}", err=True)
    return None


def _finished(result: DeformResult) -> int:
    """Number of stages whose plan was executed."""
    return sum(stage.actions is not None for stage in result.stages)


def _summary(result: DeformResult, resolved: ResolvedRun, directory: Path, *, resumed_from: Path | None) -> dict[str, Any]:
    from cpdeform.run.record_files import to_json

    configuration, memory = resolved.configuration, result.memory
    summary = {
        "task": result.task.name,
        "backend": configuration.backend,
        "ot": configuration.ot,
        "placer": configuration.placer,
        "strategy": configuration.strategy,
        "seed": result.seed,
        "status": result.status.value,
        "advice": result.status.advice,
        "loss_initial": result.loss_initial,
        "loss_final": result.loss_final,
        "metric": result.metric_name,
        "metric_initial": result.metric_initial,
        "metric_value": result.metric_value,
        "stages": _finished(result),
        "gradient_evaluations": result.gradient_evaluations,
        "rollouts": result.rollouts,
        "seconds": result.seconds,
        "memory_estimate_mb": None if memory is None else memory.estimate / 1e6,
        "peak_memory_mb": None if memory is None or memory.peak is None else memory.peak / 1e6,
        "resumed_from": None if resumed_from is None else str(resumed_from),
        "out": str(directory),
    }
    return {key: to_json(value) for key, value in summary.items()}


def _effort(result: DeformResult) -> str:
    from cpdeform.core.wording import counted

    return f"{counted(result.gradient_evaluations, 'gradient evaluation')}, {counted(result.rollouts, 'rollout')} without gradient"


def _print_summary(
    result: DeformResult, directory: Path, picture: Path | None, *, resumed_from: Path | None, first_stage: int
) -> None:
    from cpdeform.cli.progress import megabytes
    from cpdeform.core.wording import counted

    lines = [
        f"{result.task.name}: {result.status.value.replace('_', ' ')}",
        f"  loss     {result.loss_initial:.4g} -> {result.loss_final:.4g}",
        f"  metric   {result.metric_name.replace('_', ' ')} {result.metric_initial:.4g} -> {result.metric_value:.4g}",
        f"  effort   {counted(_finished(result), 'stage')}, {_effort(result)}, {result.seconds:.1f} s",
    ]
    if result.memory is not None and result.memory.peak is not None:
        figures = f"{megabytes(result.memory.peak)} at the peak, {megabytes(result.memory.estimate)} estimated"
        lines.append(f"  memory   {figures} (rollout and gradient, worlds {result.memory.worlds})")
    if resumed_from is not None:
        lines.append(f"  resumed  from {resumed_from}, at stage {first_stage + 1}")
    lines.append(f"  record   {directory}")
    if picture is not None:
        lines.append(f"  picture  {picture}")
    if result.status.advice:
        lines.append(f"  advice   {result.status.advice}")
    typer.echo("\n".join(lines))
