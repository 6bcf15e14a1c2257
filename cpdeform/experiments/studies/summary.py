"""What a study's summary consists of, and how it is written."""

from __future__ import annotations

import csv
import dataclasses
import io
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from cpdeform.experiments.studies.figures import save_figure
from cpdeform.run.record_files import replacing

SUMMARY_FILE, VALUES_FILE, FIGURE = "summary.md", "summary.csv", "figure"

INTERVAL_NOTE = (
    "Means over seeds with 95% bootstrap intervals in brackets; a figure without one is of a single seed, and intervals of a few "
    "seeds are rough. Runs that failed are listed in table.md and left out."
)


@dataclasses.dataclass(frozen=True)
class Summary:
    """The summary of a study.

    Attributes:
        values: Lines of the CSV file, all with the same names.
        parts: Paragraphs and tables in Markdown.
        draw: Draws the figure; None where there is nothing to draw.
    """

    values: Sequence[Mapping[str, Any]]
    parts: Sequence[str]
    draw: Callable[[], Any] | None


def write_summary(summary: Summary, out: Path, *, title: str) -> None:
    """Write ``summary.md``, ``summary.csv``, ``figure.pdf`` and ``figure.png``."""
    out.mkdir(parents=True, exist_ok=True)
    text = "\n\n".join([f"# {title}", *summary.parts]) + "\n"
    for file, content in ((SUMMARY_FILE, text), (VALUES_FILE, csv_text(summary.values))):
        with replacing(out / file) as temporary:
            temporary.write_text(content, encoding="utf-8")
    if summary.draw is not None:
        save_figure(summary.draw(), out / FIGURE)


def csv_text(values: Sequence[Mapping[str, Any]]) -> str:
    """Lines of values as CSV, in full precision."""
    buffer = io.StringIO()
    names = list(values[0]) if values else []
    writer = csv.DictWriter(buffer, names, lineterminator="\n")
    writer.writeheader()
    writer.writerows([{name: "" if value is None else value for name, value in line.items()} for line in values])
    return buffer.getvalue()
