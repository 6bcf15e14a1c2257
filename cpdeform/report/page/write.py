"""The page of a run as a file."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from cpdeform.core.errors import CpdeformError
from cpdeform.core.plugins import Registry
from cpdeform.core.simulator import Simulator
from cpdeform.planning.result import StageResult
from cpdeform.report.page.content import ReplayedCandidate, make_page
from cpdeform.report.page.figures import figure_rows, recorded_rows
from cpdeform.report.page.html import embedded_page
from cpdeform.run.evaluation import evaluate_record
from cpdeform.run.record import RunRecord, load_record
from cpdeform.run.record_files import replacing
from cpdeform.run.replay import recorded_simulator, replay_candidates
from cpdeform.run.shape_evaluation import evaluate_shape_record

PAGE_FILE = "report.html"
LOSERS = 2
"""Candidates of each stage that lost, and are rolled out for the page, unless told otherwise."""

Told = Callable[[str], None]


def write_page(
    run: RunRecord | Path | str,
    path: Path | str | None = None,
    *,
    losers: int = LOSERS,
    evaluate: bool = True,
    told: Told | None = None,
    registry: Registry | None = None,
) -> Path:
    """Write the page of a run: one HTML file that holds everything and asks the network for nothing.

    Args:
        run: The record, or its directory.
        path: The file; defaults to ``report.html`` in the record's directory.
        losers: How many of each stage's candidates that lost are rolled out again, the best ones; a record keeps what they were,
            not where their clay went. 0 for none.
        evaluate: Whether to compute the figures of `cpdeform evaluate`; otherwise the page shows the recorded metric alone.
        told: Is told what takes time.
        registry: Where the record's simulator is looked up; defaults to the installed plugins.

    Returns:
        The file.

    Raises:
        InputError: There is no record, it is damaged, or no stage is complete.
    """
    record = run if isinstance(run, RunRecord) else load_record(run)
    record.state  # noqa: B018 - raises without a complete stage
    told = told or (lambda line: None)
    figures: Sequence[Mapping[str, Any]] = recorded_rows(record.run)
    if evaluate:
        told("computing the figures")
        figures = _figures(record, told)
    replays = _replays(record, losers, told, registry)
    told("packing positions")
    text = embedded_page(make_page(record, figures=figures, replays=replays))
    path = Path(path) if path is not None else record.directory / PAGE_FILE
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return path


def _figures(record: RunRecord, told: Told) -> Sequence[Mapping[str, Any]]:
    """All figures; those of the shape need a simulator for clay to rest in, and are left out where there is none."""
    evaluation = evaluate_record(record)
    try:
        shape = evaluate_shape_record(record)
    except CpdeformError as error:
        told(f"shapes as they are, not at rest: {error}")
        shape = evaluate_shape_record(record, from_rest=False)
    return figure_rows(evaluation, shape)


def _replays(record: RunRecord, losers: int, told: Told, registry: Registry | None) -> dict[int, list[ReplayedCandidate]]:
    """Roll out the best candidates that lost, of each stage."""
    lost = {stage.index: _losers(stage, losers) for stage in record.stages}
    if not any(lost.values()):
        return {}
    try:
        simulator = recorded_simulator(record, worlds=max(map(len, lost.values())), registry=registry)
    except CpdeformError as error:
        told(f"candidates that lost are shown as placed, not as rolled out: {error}")
        return {}
    return {stage.index: _replay(simulator, stage, lost[stage.index], told) for stage in record.stages if lost[stage.index]}


def _losers(stage: StageResult, count: int) -> list[int]:
    """The candidates with the lowest losses that were not executed."""
    others = [number for number in range(len(stage.candidates)) if number != stage.best]
    return sorted(others, key=lambda number: stage.candidates[number].loss)[:count]


def _replay(simulator: Simulator, stage: StageResult, numbers: Sequence[int], told: Told) -> list[ReplayedCandidate]:
    """Roll them out; a plan whose clay left the finite numbers is left out."""
    told(f"rolling out candidates of stage {stage.index + 1} that lost")
    replay = replay_candidates(simulator, stage, numbers)
    return [
        ReplayedCandidate(number, positions.double().numpy(), poses.double().numpy())
        for number, positions, poses in zip(numbers, replay.positions, replay.tool_poses, strict=True)
        if bool(positions.isfinite().all())
    ]
