"""The tables of an experiment, as Markdown and CSV, beside the paper's figures."""

from __future__ import annotations

import csv
import dataclasses
import importlib.resources
import io
import json
import statistics
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

from cpdeform.core.reading.json_text import read_json
from cpdeform.experiments.experiment import family
from cpdeform.experiments.experiment_plan import METHODS, MULTI_STAGE, OWN_OPTIONS, SINGLE_STAGE
from cpdeform.experiments.experiment_row import ExperimentRow
from cpdeform.experiments.shape_figures import SHAPE_FIGURES, SHAPE_NOTE
from cpdeform.experiments.tables import cell, machine_line, markdown
from cpdeform.run.record_files import replacing, to_json

TABLE_FILE, CSV_FILE, SESSIONS_FILE = "table.md", "table.csv", "experiment.json"

COLUMNS: Mapping[str, tuple[str, str]] = {
    "task": ("task", ""),
    "method": ("method", ""),
    "seed": ("seed", "d"),
    "status": ("status", ""),
    "stages": ("stages done", ""),
    "particles": ("particles", "d"),
    "w1_initial": ("W1 initial", ".5f"),
    "w1_final": ("W1 final", ".5f"),
    "ratio_above_floor": ("ratio above floor", ".3f"),
    "incremental_iou": ("incremental IoU", ".3f"),
    "w1_floor": ("W1 floor", ".5f"),
    "w1_paper_initial": ("paper's W1 initial", ".5f"),
    "w1_paper_final": ("paper's W1 final", ".5f"),
    "w1_paper_floor": ("paper's W1 floor", ".5f"),
    "shape_iou_start": ("shape IoU start", ".3f"),
    "shape_iou_final": ("shape IoU final", ".3f"),
    "shape_iou_ceiling": ("shape IoU ceiling", ".3f"),
    "normalised_shape_iou": ("normalised shape IoU", ".3f"),
    "silhouette_iou_x": ("silhouette IoU x", ".3f"),
    "silhouette_iou_y": ("silhouette IoU y", ".3f"),
    "silhouette_iou_z": ("silhouette IoU z", ".3f"),
    "loose_share": ("loose share", ".3f"),
    "distance_95_result_to_goal": ("95% distance to goal, cells", ".1f"),
    "distance_95_goal_to_result": ("95% distance from goal, cells", ".1f"),
    "gradient_evaluations": ("gradient evaluations", "d"),
    "rollouts": ("rollouts", "d"),
    "seconds": ("seconds", ".0f"),
}
"""Title and format of the columns of the table of runs."""

OPTIONAL_COLUMNS = ("w1_paper_initial", "w1_paper_final", "w1_paper_floor", *SHAPE_FIGURES)
"""Left out where no row has the figure."""

FIGURES: Mapping[str, tuple[str, str]] = {
    "w1_final": ("W1 at the end, length units (less is better)", ".4f"),
    "w1_paper_final": ("W1 at the end with the paper's settings (less is better)", ".4f"),
    "incremental_iou": ("Normalised incremental IoU (more is better)", ".2f"),
}
"""What the short tables show, and in which format."""

SHORT_TABLES: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {MULTI_STAGE: ("w1_final", "w1_paper_final"), SINGLE_STAGE: ("incremental_iou",)}
)
"""Which of them belong to an experiment; the paper's figures stand beside each."""

NOTES = (
    "W1: transport distance between particles and goal, converged, in edges of the domain; W1 floor: between the goal and a random "
    "sample of its shape, which a perfect result would have; ratio above floor: (final - floor) / (initial - floor), 0 is "
    "perfect and 1 is the start. Gradient evaluations count every world: a stage of `cpdeform` shares its iterations out among its "
    "candidates by successive halving, `paper` gives each all of them, and `fixed` and `random` have a single one."
)


FLOOR_NOTE = (
    "Some goals have another number of particles than the body. The floor is that of a sample as large as the goal: with "
    "fewer particles than the goal a perfect result stays above it, and the ratio above the floor is too large."
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class PaperFigures:
    """Figures of the paper for one experiment.

    Attributes:
        source: The paper.
        table: Where in it.
        figure: Field of `ExperimentRow` that they are to be held against.
        note: What to bear in mind.
        tasks: Figure by task, without variants; a task that is not there is not known.
    """

    source: str
    table: str
    figure: str
    note: str
    tasks: Mapping[str, float]


def paper_figures(name: str) -> PaperFigures:
    """The paper's figures for ``"multi-stage"`` or ``"single-stage"``, from ``paper.yaml``."""
    import yaml

    text = (importlib.resources.files("cpdeform.experiments") / "paper.yaml").read_text(encoding="utf-8")
    content = yaml.safe_load(text)
    return PaperFigures(source=content["source"], **content[name])


def write_tables(name: str, rows: Sequence[ExperimentRow], out: Path, *, planned: int) -> None:
    """Write ``table.md`` and ``table.csv``.

    Args:
        name: Name of the experiment.
        rows: A row for each run that is done.
        out: Where to write.
        planned: Number of runs asked for.
    """
    out.mkdir(parents=True, exist_ok=True)
    rows = sorted_rows(rows)
    contents = {TABLE_FILE: table_text(name, rows, sessions=read_sessions(out), planned=planned), CSV_FILE: csv_text(rows)}
    for file, content in contents.items():
        with replacing(out / file) as temporary:
            temporary.write_text(content, encoding="utf-8")


def sorted_rows(rows: Iterable[ExperimentRow]) -> list[ExperimentRow]:
    """Rows by task in the order they came, then by method and seed."""
    rows = list(rows)
    tasks = list(dict.fromkeys(row.task for row in rows))
    return sorted(rows, key=lambda row: (tasks.index(row.task), list(METHODS).index(row.method), row.seed))


def csv_text(rows: Iterable[ExperimentRow]) -> str:
    """All fields of the rows but their configuration, in full precision."""
    names = [field.name for field in dataclasses.fields(ExperimentRow) if field.name != "configuration"]
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(names)
    writer.writerows([["" if (value := getattr(row, name)) is None else value for name in names] for row in rows])
    return buffer.getvalue()


def table_text(name: str, rows: Sequence[ExperimentRow], *, sessions: Sequence[Mapping[str, Any]], planned: int) -> str:
    """The whole of ``table.md``; arguments as for `write_tables`."""
    kind = SINGLE_STAGE if name == SINGLE_STAGE else MULTI_STAGE
    paper = paper_figures(kind)
    done = f"{len(rows)} of {planned} runs" if len(rows) < planned else f"{planned} run{'s' if planned != 1 else ''}"
    parts = [f"# Experiment {name}", f"{done}.", runs_table(rows), *_reasons(rows), NOTES]
    if any(row.goal_particles not in (None, row.particles) for row in rows):
        parts.append(FLOOR_NOTE)
    if any(row.shape_iou_final is not None for row in rows):
        parts.append(SHAPE_NOTE)
    blurs = sorted({row.w1_paper_blur for row in rows if row.w1_paper_blur is not None})
    if blurs:
        parts.append(f"Paper's W1: GeomLoss's default schedule, blur {' or '.join(f'{blur:g}' for blur in blurs)}, not converged.")
    for figure in SHORT_TABLES[kind]:
        table = short_table(rows, figure, paper=paper)
        if table:
            parts += [f"## {FIGURES[figure][0]}", table]
    parts += [f'{_means_note(kind)} Paper: {paper.source}, {paper.table}; "-": not known to this project. {paper.note}']
    parts += ["## Settings and hardware", *_settings_lines(rows), *_session_lines(sessions)]
    return "\n\n".join(parts) + "\n"


def runs_table(rows: Sequence[ExperimentRow]) -> str:
    """A line for each run, failures included."""
    columns = {
        name: column
        for name, column in COLUMNS.items()
        if name not in OPTIONAL_COLUMNS or any(getattr(row, name) is not None for row in rows)
    }
    return markdown([title for title, _ in columns.values()], [[_cell(row, name) for name in columns] for row in rows])


def _cell(row: ExperimentRow, name: str) -> str:
    if name == "stages":
        return "-" if row.stages is None else f"{row.stages}/{row.stages_planned}"
    return cell(getattr(row, name), COLUMNS[name][1])


def _reasons(rows: Iterable[ExperimentRow]) -> list[str]:
    """Why runs have no better result, a line each."""
    lines = [
        f"- {row.task}, {row.method}, seed {row.seed}: {row.status}{' - ' + row.reason if row.reason else ''}"
        for row in rows
        if row.reason or not row.over
    ]
    return ["\n".join(lines)] if lines else []


def short_table(rows: Sequence[ExperimentRow], figure: str, *, paper: PaperFigures) -> str:
    """One row a task, one column a method: means over seeds and variants, beside the paper's; empty where there is no figure."""
    pattern = FIGURES[figure][1]
    methods = [method for method in METHODS if any(row.method == method for row in rows)]
    if all(getattr(row, figure) is None for row in rows):
        return ""
    start = {"w1_final": ("w1_initial", "w1_floor"), "w1_paper_final": ("w1_paper_initial", "w1_paper_floor")}.get(figure, ())
    lines = []
    for task in dict.fromkeys(family(row.task) for row in rows):
        own = [row for row in rows if family(row.task) == task]
        known = [[value for row in own if (value := getattr(row, name)) is not None] for name in start]
        before = [cell(statistics.fmean(values) if values else None, pattern) for values in known]
        means = [_mean([row for row in own if row.method == method], figure, pattern) for method in methods]
        lines.append([task, *before, *means, cell(paper.tasks.get(task), pattern)])
    titles = {"w1_initial": "initial", "w1_paper_initial": "initial", "w1_floor": "floor", "w1_paper_floor": "floor"}
    return markdown(["task", *(titles[name] for name in start), *methods, "CPDeform in the paper"], lines)


def _mean(rows: Sequence[ExperimentRow], figure: str, pattern: str) -> str:
    """Mean and standard deviation over the runs that came to an end, and how many of them there are if not all."""
    values = [value for row in rows if row.over and (value := getattr(row, figure)) is not None]
    if not values:
        return "-" if not rows else f"- (0 of {len(rows)})"
    spread = f" ± {statistics.stdev(values):{pattern}}" if len(values) > 1 else ""
    missing = f" ({len(values)} of {len(rows)})" if len(values) < len(rows) else ""
    return f"{statistics.fmean(values):{pattern}}{spread}{missing}"


def _means_note(name: str) -> str:
    over = "seeds" if name == MULTI_STAGE else "variants and seeds"
    return (
        f"Means, and standard deviations where there are several, over {over}; a run that found no plan counts with the state it "
        'ended in, one that failed does not count ("2 of 3").'
    )


def _settings_lines(rows: Iterable[ExperimentRow]) -> list[str]:
    """What the runs were configured with where it is not the default: in common, then method by method."""
    rows = [row for row in rows if row.configuration]
    if not rows:
        return []
    flat = [_settings(row) for row in rows]
    common = {key: value for key, value in flat[0].items() if all(key in other and other[key] == value for other in flat)}
    groups: dict[tuple[str, str], list[str]] = {}
    for row, own in zip(rows, flat, strict=True):
        text = ", ".join(f"{key}={value}" for key, value in own.items() if key not in common)
        groups.setdefault((row.method, text), []).append(row.task)
    lines = [f"- all runs: {', '.join(f'{key}={value}' for key, value in common.items()) or 'defaults'}"]
    for (method, text), tasks in groups.items():
        if text:
            lines.append(f"- {method} on {', '.join(dict.fromkeys(tasks))}: {text}")
    return ["\n".join(lines)]


def _settings(row: ExperimentRow) -> dict[str, str]:
    """A run's settings that are not the default, by dotted name, and where its goal comes from."""
    from cpdeform.run.configuration import RunConfiguration

    defaults = dict(_flatten(RunConfiguration().model_dump(mode="json")))
    settings = {
        key: json.dumps(value, separators=(",", ":")) if isinstance(value, (list, dict)) else str(value)
        for key, value in _flatten(row.configuration)
        if key not in OWN_OPTIONS and (key not in defaults or defaults[key] != value)
    }
    settings["goal"] = "the task's own" if row.configuration.get("goal") is None else "a given file"
    return settings


def _flatten(content: Mapping[str, Any], prefix: str = "") -> Iterable[tuple[str, Any]]:
    for key, value in content.items():
        if isinstance(value, Mapping):
            yield from _flatten(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def _session_lines(sessions: Iterable[Mapping[str, Any]]) -> list[str]:
    """Commands, machines and versions that the runs were made with."""
    lines = []
    for session in sessions:
        line = f"- `{session['command']}` on {machine_line(session['machine'], session['versions'])}"
        if line not in lines:
            lines.append(line)
    return ["\n".join(lines) if lines else "Not known: no run was made by `cpdeform experiment`."]


def read_sessions(out: Path) -> list[dict[str, Any]]:
    """Who made the runs of a directory: command, machine and versions of each session that ran something."""
    try:
        sessions: list[dict[str, Any]] = read_json(out / SESSIONS_FILE, argument=str(out / SESSIONS_FILE))["sessions"]
        return sessions
    except (OSError, ValueError, KeyError, TypeError):
        return []


def note_session(out: Path, *, command: str, machine: Mapping[str, Any], versions: Mapping[str, Any]) -> None:
    """Add a session to a directory, to be called before its first run."""
    out.mkdir(parents=True, exist_ok=True)
    sessions = [*read_sessions(out), {"command": command, "machine": dict(machine), "versions": dict(versions)}]
    with replacing(out / SESSIONS_FILE) as temporary:
        temporary.write_text(json.dumps(to_json({"sessions": sessions}), indent=2) + "\n", encoding="utf-8")
