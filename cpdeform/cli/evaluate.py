"""`cpdeform evaluate`: all figures of a finished run."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from cpdeform.run.clearance import Clearances
    from cpdeform.run.evaluation import Evaluation


def evaluate(
    directory: Annotated[Path, typer.Argument(help="A run record, see `cpdeform run --out`.", metavar="DIR")],
    paper: Annotated[
        bool, typer.Option("--paper", help="Also the paper's Wasserstein distance: GeomLoss's schedule (minutes).")
    ] = False,
    paper_blur: Annotated[
        float | None, typer.Option(help="Its blur. Defaults to 1e-3, or 1e-5 for tasks of several stages.", metavar="LENGTH")
    ] = None,
    exact: Annotated[bool, typer.Option("--exact", help="Also the exact Wasserstein distance (minutes, gigabytes).")] = False,
    at_rest: Annotated[
        bool, typer.Option("--rest/--no-rest", help="Let start, result and goal come to rest before their shapes are compared.")
    ] = True,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Compute the figures that results are compared by, the same way for every method."""
    from cpdeform.core.errors import InputError
    from cpdeform.run.clearance import measure_clearances
    from cpdeform.run.evaluation import evaluate_record
    from cpdeform.run.record import load_record
    from cpdeform.run.record_files import to_json
    from cpdeform.run.shape_evaluation import evaluate_shape_record
    from cpdeform.run.shape_text import shape_text

    if paper_blur is not None and not 0.0 < paper_blur < float("inf"):
        raise InputError("--paper-blur", came=f"{paper_blur}", expected="a positive length, such as 1e-3")
    record = load_record(directory)
    with contextlib.redirect_stdout(sys.stderr) if as_json else contextlib.nullcontext():
        result = evaluate_record(record, paper=paper or paper_blur is not None, paper_blur=paper_blur, exact=exact)
        shape = evaluate_shape_record(record, from_rest=at_rest)
        clearances = measure_clearances(record)
    if as_json:
        figures = {**dataclasses.asdict(result), **shape.as_dict(), **dataclasses.asdict(clearances)}
        typer.echo(json.dumps(to_json({"record": str(directory), **figures})))
    else:
        typer.echo(f"{_text(result)}\n{shape_text(shape)}\n{_clearance_text(clearances)}")


def _text(result: Evaluation) -> str:
    lines = [
        f"{result.task}: {result.particle_count} particles, {result.goal_count} in the goal",
        f"  incremental IoU  {result.incremental_iou:.4f}   (IoU {result.iou_start:.4f} -> {result.iou_final:.4f}, at most "
        f"{result.iou_goal:.4f}; the goal's node masses from its {result.grid})",
        f"  Wasserstein-1    {_change(result.wasserstein_start, result.wasserstein_final)}   (debiased, blur "
        f"{result.wasserstein_blur:g}, {'' if result.converged else 'NOT '}converged, {result.solver})",
    ]
    if result.paper_start is not None and result.paper_final is not None:
        kind = f"GeomLoss's schedule, blur {result.paper_blur:g}"
        floor = "" if result.paper_floor is None else f", floor {result.paper_floor:.6f}"
        lines.append(f"    as the paper   {_change(result.paper_start, result.paper_final)}   ({kind}{floor})")
    if result.exact_start is not None and result.exact_final is not None:
        lines.append(f"    exact          {_change(result.exact_start, result.exact_final)}   ({result.exact_method})")
    reason = "the goal's particles are the body's" if result.corresponds else "a random sample of the goal's shape"
    lines.append(f"    floor          {result.sampling_floor:.6f}   ({reason})")
    return "\n".join(lines)


def _clearance_text(found: Clearances) -> str:
    names = {"start": "clay at a stage's start", "tools": "between tools", "floor": "floor", "way": "way to the next stage"}
    values = {text: getattr(found, f"clearance_{name}") for name, text in names.items()}
    known = [f"{text} {value:.4f}" for text, value in values.items() if value is not None]
    return f"  least clearance  {', '.join(known) or 'nothing was executed'}"


def _change(start: float, final: float) -> str:
    return f"{start:.6f} -> {final:.6f}"
