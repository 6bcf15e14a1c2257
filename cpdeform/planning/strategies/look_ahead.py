"""A search that looks ahead: several states go on from stage to stage, and the path with the best end is the plan."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence

from cpdeform.core.errors import InputError
from cpdeform.core.state import State
from cpdeform.planning.algorithm import Planner, Start
from cpdeform.planning.effort import Effort
from cpdeform.planning.interrupted import StageInterrupted
from cpdeform.planning.result import StageResult, Status
from cpdeform.planning.strategies.cpdeform import StrategyCpdeform


@dataclasses.dataclass(frozen=True)
class Path:
    """A way from the start to here.

    Attributes:
        results: The stages so far.
        state: The state now, a single world.
    """

    results: tuple[StageResult, ...]
    state: State

    @property
    def warm(self) -> tuple[object, ...] | None:
        """What the objective can start from here."""
        return self.results[-1].warm if self.results else None

    @property
    def loss(self) -> float:
        """Loss here; infinity at the start."""
        return self.results[-1].loss if self.results else float("inf")

    def then(self, result: StageResult) -> Path:
        """The way with one more stage."""
        return Path((*self.results, result), result.state)


class StrategyLookAhead(StrategyCpdeform):
    """A beam over stages: each stage goes on from the best ends of the one before, by each end's best candidates.

    What was spent on ways that were given up counts in the stages of the one that is returned.

    Args:
        width: Number of states that go on from each stage.

    Raises:
        InputError: `width` is below 1.
    """

    def __init__(self, *, width: int = 2) -> None:
        if width < 1:
            raise InputError("width", came=str(width), expected="at least 1")
        self.width = width

    def effort(self, stage: Effort) -> Effort:
        """See `Strategy`; there are several paths from the second stage on."""
        return stage.scaled(1, self.width) + Effort(rollouts=(0, self.width))

    def loop(self, planner: Planner, start: Start) -> Iterator[StageResult]:
        """Stages of the best path, known only when all paths have come to their end, or the run is interrupted."""
        paths, spent = [Path((), start.state)], list[list[StageResult]]()
        failed: tuple[StageResult, ...] = ()
        for index in range(start.first_stage, start.first_stage + start.stages):
            ends: list[Path] = []
            tried: list[StageResult] = []
            spent.append(tried)
            for path in paths:
                try:
                    result = planner.stage(start, index, path.state, path.results, warm=path.warm)
                    found = self._ends(planner, result)
                except KeyboardInterrupt as interruption:
                    if isinstance(interruption, StageInterrupted):
                        tried.append(interruption.result)
                        ends.append(path.then(interruption.result))
                    best = min([*ends, *paths], key=lambda path: path.loss)
                    yield from _counted(best.results, spent)
                    raise
                others = min(self.width, len(result.candidates)) - 1 if found else 0
                tried.append(dataclasses.replace(result, rollouts=result.rollouts + others))
                ends += [path.then(end) for end in found]
            if not ends:
                failed = (tried[0],)
                break
            paths = sorted(ends, key=lambda path: path.loss)[: self.width]
        yield from _counted((*paths[0].results, *failed), spent)

    def _ends(self, planner: Planner, result: StageResult) -> list[StageResult]:
        """What the best candidates of a stage lead to."""
        if result.status is not Status.FINISHED:
            return []
        order = sorted(range(len(result.candidates)), key=lambda number: result.candidates[number].loss)
        others = [number for number in order if number != result.best][: self.width - 1]
        found = [planner.execute_other(result, number) for number in others]
        return [result, *(end for end in found if end is not None)]


def _counted(results: Sequence[StageResult], spent: Sequence[Sequence[StageResult]]) -> Iterator[StageResult]:
    """The stages of a path, each with what was spent on the stages of its number on all paths."""
    for result, tried in zip(results, spent, strict=False):
        yield dataclasses.replace(
            result,
            gradient_evaluations=sum(other.gradient_evaluations for other in tried),
            rollouts=sum(other.rollouts for other in tried),
        )
