"""Summaries of the studies, from the runs that are done."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from cpdeform.experiments.experiment_row import ExperimentRow
from cpdeform.experiments.studies import ablation, rivals, runtime, search
from cpdeform.experiments.studies.equal_cost import known_shares
from cpdeform.experiments.studies.runs import StudyRun, study_runs
from cpdeform.experiments.studies.study import ABLATION, RIVALS, RUNTIME, STUDIES
from cpdeform.experiments.studies.summary import Summary, write_summary


def write_study(name: str, rows: Sequence[ExperimentRow], out: Path, *, planned: int) -> None:
    """Write the summary of a study; its figure once all runs are done.

    Args:
        name: A name of `STUDIES`.
        rows: A row for each run that is done.
        out: Directory of the records.
        planned: Number of runs asked for.
    """
    summary = _summary(name, study_runs(rows, out), out)
    if len(rows) < planned:
        summary = Summary(summary.values, [f"{len(rows)} of {planned} runs.", *summary.parts], None)
    write_summary(summary, out, title=STUDIES[name].title)


def _summary(name: str, runs: Sequence[StudyRun], out: Path) -> Summary:
    if name == ABLATION:
        return ablation.summarize(runs)
    if name == RUNTIME:
        return runtime.summarize(runs)
    if name == RIVALS:
        return rivals.summarize(runs, known_shares(out))
    return search.summarize(runs)
