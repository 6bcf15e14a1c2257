"""What an interrupted stage leaves: the best plan so far, executed, so that hours of descent are not lost."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Sequence

from cpdeform.core.placer import Candidate
from cpdeform.core.simulator import Trajectory
from cpdeform.planning.phases.phase import Phase
from cpdeform.planning.result import StageResult, Status
from cpdeform.planning.workbench import Workbench


@dataclasses.dataclass
class Execution:
    """The plan that a stage has executed so far: none at first, when its loss is that of leaving the state as it is.

    Attributes:
        loss: Its loss.
        warm: What the objective can start from at its end.
        trajectory: Its rollout.
        candidate: The plan, where a phase that works on the executed plan has changed it.
    """

    loss: float
    warm: tuple[object, ...] | None
    trajectory: Trajectory | None = None
    candidate: Candidate | None = None


class StageInterrupted(KeyboardInterrupt):
    """An interruption inside a stage that had a plan already; its cause is the interruption itself.

    Args:
        result: The stage with its best plan so far executed, and the status `Status.INTERRUPTED`.
    """

    def __init__(self, result: StageResult) -> None:
        super().__init__(f"interrupted in stage {result.index}")
        self.result = result


class StagesInterrupted(KeyboardInterrupt):
    """An interruption while several stages were polished together; its cause is the interruption itself.

    Args:
        results: The stages with their best plans so far executed.
    """

    def __init__(self, results: Sequence[StageResult]) -> None:
        super().__init__(f"interrupted in stages {results[0].index} to {results[-1].index}")
        self.results = tuple(results)


def best_so_far(
    bench: Workbench,
    phases: Sequence[Phase],
    execution: Execution,
    execute: Callable[[Workbench, Phase, Candidate, Execution], Status],
) -> tuple[list[Candidate], int] | None:
    """Execute the best plan that an interrupted stage has found so far.

    Args:
        bench: The stage as it is.
        phases: The phases of the stage.
        execution: What was executed already; changed.
        execute: Executes a candidate for a phase and keeps what came of it in the execution.

    Returns:
        All candidates so far and the number of the executed one; None where no plan gains anything.
    """
    candidates = _candidates(bench, searching=execution.trajectory is None)
    best = min(range(len(candidates)), key=lambda number: candidates[number].loss, default=None)
    if best is None or not candidates[best].loss < bench.loss_to_beat:
        return None
    bench.lap("optimization" if execution.trajectory is None else "refinement")
    # The interruption goes on whatever happens here: a simulator may not be able to compute after it, for example.
    with contextlib.suppress(Exception):
        if execution.trajectory is None:
            execute(bench, [phase for phase in phases if phase.scope != "plan"][-1], candidates[best], execution)
        for phase in phases:
            changed = _refined(bench, phase)
            if changed is not None:
                execute(bench, phase, changed, execution)
    if execution.trajectory is None:
        return None
    candidates[best] = execution.candidate or candidates[best]
    bench.lap("execution")
    return candidates, best


def _candidates(bench: Workbench, *, searching: bool) -> list[Candidate]:
    """Candidates of the rounds that are over, and of the running descent as they are.

    A descent by another loss than the stage's own does not count: its losses cannot be compared.
    """
    racing = bench.racing if searching else None
    if racing is None or racing.race is None or racing.objective is not bench.objective:
        return list(bench.candidates)
    race, found = racing.race, list(bench.candidates)
    rows = zip(race.best_loss.tolist(), race.best_actions, race.finite.tolist(), strict=True)
    for number, (loss, actions, finite) in enumerate(rows):
        found.append(dataclasses.replace(racing.plan(number, actions.clone()), loss=loss, finite=finite))
    return found


def _refined(bench: Workbench, phase: Phase) -> Candidate | None:
    """What the phase that was interrupted has made of the executed plan, where it lowered the phase's own loss; else None."""
    racing = bench.racing
    if phase.scope != "plan" or racing is None or racing.race is None or racing.phase != phase.name:
        return None
    if racing.first_loss is None or not float(racing.race.best_loss[0]) < racing.first_loss:
        return None
    return racing.plan(0, racing.race.best_actions[0].clone())
