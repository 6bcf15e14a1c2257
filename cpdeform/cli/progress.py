"""How far a run is, on stderr."""

from __future__ import annotations

import sys
import time
from types import TracebackType

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from torch import Tensor

from cpdeform.core.optimizer import Iteration
from cpdeform.core.result import Observer, StageResult
from cpdeform.core.task import Task

SECONDS_BETWEEN_LINES = 15.0


class ProgressBar(Observer):
    """A bar with stage, iteration, loss, best loss and time left; for terminals. A context manager.

    Args:
        stages: Number of stages; the task's own where absent.
    """

    def __init__(self, *, stages: int | None) -> None:
        self._stages = stages
        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.completed:.0f}/{task.total:.0f}"),
            TimeElapsedColumn(),
            TextColumn("left"),
            TimeRemainingColumn(),
            console=Console(stderr=True),
            transient=True,
        )
        self._bar = self._progress.add_task("preparing", total=None, visible=False)

    def __enter__(self) -> ProgressBar:
        self._progress.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._progress.stop()

    def run_started(self, task: Task, target: Tensor, names: dict[str, str], seed: int) -> None:
        """Learn the number of stages."""
        self._stages = self._stages or task.stage_count

    def iteration_finished(self, stage: int, iteration: Iteration) -> None:
        """Move the bar."""
        total = (self._stages or 1) * iteration.count
        self._progress.update(
            self._bar,
            visible=True,
            total=total,
            completed=stage * iteration.count + iteration.index + 1,
            description=f"stage {stage + 1}/{self._stages}  {_losses(iteration)}",
        )

    def stage_finished(self, result: StageResult) -> None:
        """Leave a line that stays."""
        self._progress.console.print(_stage_line(result), highlight=False)


class ProgressLines(Observer):
    """A line now and then and after each stage; for logs."""

    def __init__(self) -> None:
        self._next = time.monotonic() + SECONDS_BETWEEN_LINES

    def iteration_finished(self, stage: int, iteration: Iteration) -> None:
        """Print a line if the last one is some time ago."""
        if time.monotonic() >= self._next:
            self._next = time.monotonic() + SECONDS_BETWEEN_LINES
            text = f"stage {stage + 1}, iteration {iteration.index + 1}/{iteration.count}, {_losses(iteration)}"
            typer.echo(text, file=sys.stderr)

    def stage_finished(self, result: StageResult) -> None:
        """Print a line."""
        typer.echo(_stage_line(result), file=sys.stderr)


def _losses(iteration: Iteration) -> str:
    finite = iteration.loss[iteration.loss.isfinite()]
    now = f"{float(finite.min()):.4g}" if len(finite) else "not finite"
    return f"loss {now}  best {float(iteration.best_loss.min()):.4g}"


def _stage_line(result: StageResult) -> str:
    return (
        f"stage {result.index + 1}: {result.status.value.replace('_', ' ')}, loss {result.loss_before:.4g} -> {result.loss:.4g}, "
        f"{len(result.candidates)} candidates, {result.seconds['total']:.1f} s"
    )
