"""How far a run is, on stderr."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from types import TracebackType

import typer
from rich import progress as rich_progress
from rich.console import Console
from rich.text import Text
from torch import Tensor

from cpdeform.core.task import Task
from cpdeform.core.wording import counted
from cpdeform.planning.joint import PHASE as JOINT_POLISH
from cpdeform.planning.optimizer import SEARCH, Iteration
from cpdeform.planning.result import Observer, Revision, StageResult
from cpdeform.run.estimate import RunEstimate
from cpdeform.run.time_left import TimeLeft, duration, duration_range

SECONDS_BETWEEN_LINES = 15.0


class Progress(Observer):
    """What bar and lines have in common: the number of the batch, the memory that rollouts are about to need, and the time left."""

    _told = 0
    _batch = 0
    _time: TimeLeft | None = None

    def estimated(self, estimate: RunEstimate | None, *, stages: int) -> None:
        """Print what the run will take, and count the time from here."""
        self._time = TimeLeft(estimate, stages=stages)
        if estimate is not None:
            self._print(estimate_line(estimate))

    def part_started(self, stage: int, part: str) -> None:
        """Count batches anew in each stage."""
        if part == "transport":
            self._batch = 0
        if self._time is None:
            return
        if part == "transport":
            self._time.stage_started()
        elif part == JOINT_POLISH:
            self._time.joint_started()

    def iteration_finished(self, stage: int, iteration: Iteration) -> None:
        """Count the gradients."""
        if self._time is not None:
            self._time.evaluated(int((~iteration.loss.isnan()).sum()))

    def stage_finished(self, result: StageResult) -> None:
        """Leave a line that stays."""
        if self._time is not None:
            self._time.stage_finished()
        self._print(_stage_line(result) + self._time_text())

    def stages_revised(self, revision: Revision) -> None:
        """Leave a line that stays."""
        if self._time is not None:
            self._time.joint_finished()
        self._print(_revision_line(revision) + self._time_text())

    def _time_text(self) -> str:
        """Time that passed and time that is left, where they are known."""
        if self._time is None:
            return ""
        left = self._time.seconds()
        return f", {duration(self._time.elapsed)} so far" + ("" if not left else f", about {duration(left)} left")

    def optimization_started(self, stage: int, worlds: int, memory_estimate: int) -> None:
        """Count the batch; print the memory estimate, unless it was told for no smaller a batch."""
        self._batch += 1
        if memory_estimate > self._told:
            self._told = memory_estimate
            self._print(f"memory: about {megabytes(memory_estimate)} for rollouts and gradients, worlds {worlds}")

    def _print(self, line: str) -> None:
        typer.echo(line, file=sys.stderr)


class Starting(Observer):
    """Does something when a run starts.

    Args:
        begin: What to do.
    """

    def __init__(self, begin: Callable[[], None]) -> None:
        self._begin = begin

    def run_started(self, task: Task, goal: Tensor, names: dict[str, str], seed: int) -> None:
        """Do it."""
        self._begin()


class _Count(rich_progress.ProgressColumn):
    """Iterations done and planned; nothing while their number is unknown."""

    def render(self, task: rich_progress.Task) -> Text:
        """See rich."""
        return Text("" if task.total is None else f"{task.completed:.0f}/{task.total:.0f}")


class _Left(rich_progress.ProgressColumn):
    """The time left, as told last."""

    def __init__(self, text: Callable[[], str]) -> None:
        super().__init__()
        self._text = text

    def render(self, task: rich_progress.Task) -> Text:
        """See rich."""
        return Text(self._text(), style="progress.remaining")


class ProgressBar(Progress):
    """A bar with stage, iteration, loss, best loss and time left; for terminals. A context manager.

    Args:
        stages: Number of stages; defaults to the task's own.
        first_stage: Number of the first stage.
    """

    def __init__(self, *, stages: int | None, first_stage: int = 0) -> None:
        self._stages = stages
        self._first_stage = first_stage
        self._progress = rich_progress.Progress(
            rich_progress.TextColumn("{task.description}"),
            rich_progress.BarColumn(),
            _Count(),
            rich_progress.TimeElapsedColumn(),
            _Left(self._left_text),
            console=Console(stderr=True),
            transient=True,
        )
        self._bar = self._progress.add_task("preparing", total=None, visible=False)

    def __enter__(self) -> ProgressBar:
        self._progress.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._progress.stop()

    def _left_text(self) -> str:
        left = None if self._time is None else self._time.seconds()
        return "" if left is None else f"about {duration(left)} left"

    def run_started(self, task: Task, goal: Tensor, names: dict[str, str], seed: int) -> None:
        """Learn the number of stages."""
        self._stages = self._stages or task.stage_count

    def part_started(self, stage: int, part: str) -> None:
        """Say what goes on, so that the screen is not blank while transport is solved."""
        super().part_started(stage, part)
        total = self._first_stage + (self._stages or 1)
        self._progress.update(self._bar, visible=True, description=f"stage {stage + 1}/{total}  {part}")

    def iteration_finished(self, stage: int, iteration: Iteration) -> None:
        """Move the bar; a refinement, whose length is its own, only changes the text."""
        super().iteration_finished(stage, iteration)
        if iteration.phase != SEARCH:
            self._progress.update(self._bar, description=f"stage {stage + 1} {iteration.phase}  {_losses(iteration)}")
            return
        total = (self._stages or 1) * iteration.count
        self._progress.update(
            self._bar,
            visible=True,
            total=total,
            completed=(stage - self._first_stage) * iteration.count + iteration.index + 1,
            description=f"stage {stage + 1}/{self._first_stage + (self._stages or 1)}, batch {self._batch}  {_losses(iteration)}",
        )

    def _print(self, line: str) -> None:
        self._progress.console.print(line, highlight=False)


class ProgressLines(Progress):
    """A line now and then and after each stage; for logs."""

    def __init__(self) -> None:
        self._next = time.monotonic() + SECONDS_BETWEEN_LINES

    def part_started(self, stage: int, part: str) -> None:
        """Print a line where a stage begins, before transport, which may take a while."""
        super().part_started(stage, part)
        if part == "transport":
            self._print(f"stage {stage + 1}: {part}")

    def iteration_finished(self, stage: int, iteration: Iteration) -> None:
        """Print a line if the last one is some time ago."""
        super().iteration_finished(stage, iteration)
        if time.monotonic() >= self._next:
            self._next = time.monotonic() + SECONDS_BETWEEN_LINES
            name = "iteration" if iteration.phase == SEARCH else iteration.phase
            text = f"stage {stage + 1}, batch {self._batch}, {name} {iteration.index + 1}/{iteration.count}, {_losses(iteration)}"
            self._print(text + self._time_text())


def estimate_line(estimate: RunEstimate) -> str:
    """What a run will take, in a line."""
    least, most = estimate.total.gradients
    memory = " to ".join(megabytes(count) for count in estimate.memory)
    work = f"{counted(estimate.stages, 'stage')}, {least} to {most} gradient evaluations"
    return f"estimate: {duration_range(estimate.seconds)}, memory {memory} ({work}; pictures left out)"


def megabytes(count: int) -> str:
    """Bytes as text, in megabytes of 1e6 bytes, or in gigabytes."""
    return f"{count / 1e9:.2g} GB" if count >= 1e9 else f"{count / 1e6:.3g} MB"


def _losses(iteration: Iteration) -> str:
    finite = iteration.loss[iteration.loss.isfinite()]
    now = f"{float(finite.min()):.4g}" if len(finite) else "not finite"
    return f"loss {now}  best {float(iteration.best_loss.min()):.4g}"


def _stage_line(result: StageResult) -> str:
    return (
        f"stage {result.index + 1}: {result.status.value.replace('_', ' ')}, loss {result.loss_before:.4g} -> {result.loss:.4g}, "
        f"{counted(len(result.candidates), 'candidate')}, {result.seconds['total']:.1f} s"
    )


def _revision_line(revision: Revision) -> str:
    first, last = revision.results[0], revision.results[-1]
    which = f"stage {last.index + 1}" if first is last else f"stages {first.index + 1} to {last.index + 1}"
    return f"{which}: {revision.reason}, loss {first.loss_before:.4g} -> {last.loss:.4g}"
