"""`cpdeform bench cards`: a page for each task of an experiment's table."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def bench_cards_command(
    table: Annotated[
        Path, typer.Argument(help="summary.csv of `cpdeform experiment rivals` or `search`.", metavar="TABLE", show_default=False)
    ],
    out: Annotated[Path, typer.Option(help="Directory of the cards and their pictures.", metavar="DIR")] = Path("docs/benchmark"),
) -> None:
    """Write a benchmark card for each task of an experiment: scene, goal, budget, figures, command, picture."""
    from cpdeform.core.plugins import load_registry
    from cpdeform.experiments.studies.cards import write_cards

    for card in write_cards(table, out, registry=load_registry()):
        typer.echo(f"written to {card}")
