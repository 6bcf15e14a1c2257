"""Benchmark cards: a page for each task with scene, goal, budget, every method's figures, the command and a picture."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from cpdeform.core.errors import InputError
from cpdeform.core.plugins import Registry
from cpdeform.core.task import Task, load_task
from cpdeform.experiments.experiment_tables import read_sessions
from cpdeform.experiments.studies.statistics import Interval
from cpdeform.experiments.tables import cell, machine_line, markdown
from cpdeform.run.record_files import replacing

COLUMNS = ("task", "method", "seeds", "w1_final", "w1_final_low", "w1_final_high")
"""What a table must have; ``cost`` and ``seconds`` are shown where they are there."""


def write_cards(table: Path, out: Path, *, registry: Registry) -> list[Path]:
    """Write a card for each task of a table, and an index of them.

    Args:
        table: ``summary.csv`` of the study `rivals` or `search`; the ``experiment.json`` beside it tells command and machine.
        out: Directory of the cards and their pictures.
        registry: Where tasks are looked up.

    Returns:
        The cards.

    Raises:
        InputError: The table cannot be used.
    """
    lines = _read(table)
    out.mkdir(parents=True, exist_ok=True)
    sessions = read_sessions(table.parent)
    cards = []
    for name in dict.fromkeys(line["task"] for line in lines):
        task = load_task(name, registry=registry)
        picture = _file_name(name) + ".png"
        _draw(task, out / picture)
        text = card_text(task, [line for line in lines if line["task"] == name], sessions=sessions, picture=picture)
        cards.append(out / f"{_file_name(name)}.md")
        _write(cards[-1], text)
    index = "\n".join(f"- [{path.stem}]({path.name})" for path in cards)
    _write(out / "README.md", f"# Benchmark cards\n\nOne for each task, from the table of an experiment.\n\n{index}\n")
    return cards


def card_text(task: Task, lines: Sequence[Mapping[str, str]], *, sessions: Sequence[Mapping[str, Any]], picture: str) -> str:
    """The card of a task.

    Args:
        task: The task.
        lines: Its lines of the table.
        sessions: Commands, machines and versions that the runs were made with.
        picture: File name of its picture.
    """
    made = [f"- `{session['command']}` on {machine_line(session['machine'], session['versions'])}" for session in sessions]
    parts = [
        f"# {task.name}",
        f"{task.summary}.",
        f"![start and goal of {task.name}]({picture})",
        "## Scene and goal",
        markdown(["", ""], _scene_rows(task)),
        "## Figures",
        _figures(lines),
        "W1 at the end in edges of the domain, less is better: means over seeds with 95% bootstrap intervals; a dash where "
        "every run failed. Cost: gradient evaluations, a rollout without gradient counted by its measured share.",
        "## How they were made",
        "\n".join(dict.fromkeys(made)) or "Not known: there is no experiment.json beside the table.",
    ]
    return "\n\n".join(parts) + "\n"


def _scene_rows(task: Task) -> list[list[str]]:
    scene = task.scene
    bodies = "; ".join(f"{body.kind} of {body.particle_count} particles" for body in scene.bodies)
    tools = "; ".join(f"{tool.kind}{'' if tool.movable else ' (fixed)'}" for tool in scene.tools)
    steps = f"{task.step_count}" + (f" and {task.rest_steps} of rest" if task.rest_steps else "")
    material = scene.material
    return [
        ["clay", bodies],
        ["material", f"E {material.youngs_modulus:g}, nu {material.poisson_ratio:g}, yield stress {material.yield_stress:g}"],
        ["tools", tools],
        [
            "goal",
            f"{len(task.load_goal())} particles, {'those of the body, moved' if task.goal_corresponds() else 'another sample'}",
        ],
        ["budget", f"{task.stage_count} stage{'' if task.stage_count == 1 else 's'} of {steps} environment steps"],
        ["metric", task.metric.replace("_", " ")],
    ]


def _figures(lines: Sequence[Mapping[str, str]]) -> str:
    extra = [name for name in ("cost", "gradient_evaluations", "seconds") if any(line.get(name) for line in lines)]
    rows = []
    for line in sorted(lines, key=lambda line: (math.isnan(_number(line["w1_final"])), _number(line["w1_final"]))):
        value, low, high = (_number(line[name]) for name in ("w1_final", "w1_final_low", "w1_final_high"))
        interval = Interval(value, low, high, int(line["seeds"]))
        values = [_number(line.get(name, "")) for name in extra]
        effort = (cell(None if math.isnan(value) else value, ".0f") for value in values)
        rows.append([line["method"], line["seeds"], interval.text(".4f"), *effort])
    return markdown(["method", "seeds", "W1 at the end", *(name.replace("_", " ") for name in extra)], rows)


def _read(table: Path) -> list[dict[str, str]]:
    try:
        with table.open(encoding="utf-8", newline="") as file:
            lines = list(csv.DictReader(file))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError("TABLE", came=f"{table} ({error})", expected="the summary.csv of an experiment") from error
    missing = [name for name in COLUMNS if not lines or name not in lines[0]]
    if missing:
        remedy = "Make it with `cpdeform experiment rivals` or `search`."
        came = f"{table} without {', '.join(missing)}"
        raise InputError("TABLE", came=came, expected="the summary.csv of an experiment", remedy=remedy)
    return lines


def _number(text: str | None) -> float:
    try:
        return float(text) if text else math.nan
    except ValueError:
        return math.nan


def _file_name(task: str) -> str:
    return task.replace("++", "-plus-plus")


def _write(path: Path, text: str) -> None:
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _draw(task: Task, path: Path) -> None:
    """Start with the tools above, and goal, side by side."""
    from cpdeform.report.task_panels import draw_task

    with replacing(path) as temporary:
        draw_task(task, temporary)
