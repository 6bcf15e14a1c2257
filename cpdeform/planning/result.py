"""What a run produces: failures are data, with advice."""

from __future__ import annotations

import dataclasses
import enum

from torch import Tensor

from cpdeform.core.memory import MemoryUse
from cpdeform.core.placer import Candidate
from cpdeform.core.state import State
from cpdeform.core.task import Task
from cpdeform.planning.optimizer import Iteration


class Status(enum.Enum):
    """How a stage, and with its last stage a run, ended."""

    FINISHED = "finished"
    NO_IMPROVEMENT = "no_improvement"
    NO_PLACEMENT = "no_placement"
    NON_FINITE = "non_finite"
    INTERRUPTED = "interrupted"

    @property
    def executed(self) -> bool:
        """Whether a plan was executed, so that the state is another one."""
        return self in (Status.FINISHED, Status.INTERRUPTED)

    @property
    def advice(self) -> str:
        """What the user can do about it."""
        return _ADVICE[self]


_ADVICE = {
    Status.FINISHED: "",
    Status.NO_IMPROVEMENT: (
        "No plan lowered the loss any further, so the last stage executed none. Try another strategy (--strategy), placer "
        "or seed, more iterations (--iterations), or a larger blur (--set objective.blur=0.01)."
    ),
    Status.NO_PLACEMENT: (
        "The placer found no position of the tools that is within their bounds and free of collision with the body. "
        "Check the tools' bounds and size, or use --placer fixed."
    ),
    Status.NON_FINITE: (
        "Every plan's simulation left the finite numbers before it lowered the loss, or the best one did when it was executed. "
        "Lower the action scale, the stiffness or the time step of the scene."
    ),
    Status.INTERRUPTED: "Interrupted; the best plan so far was executed. Go on from there with --resume.",
}


@dataclasses.dataclass(frozen=True)
class StageResult:
    """One stage of Algorithm 1.

    Attributes:
        index: Number of the stage, from 0; a resumed run goes on counting.
        status: How it ended; the state is unchanged unless `Status.executed`.
        state_before: State S_i, a single world, tools as the stage found them.
        state: State S_{i+1} after the executed plan.
        priorities: Transport priorities f (N,), cost or length units (see `transport_priorities`); nan where the placer needs none.
        candidates: Every placement tried and what became of it.
        best: Index of the executed candidate; None where none was executed.
        actions: Executed actions (T, A); None where none was executed.
        positions: Particle positions (T+1, N, 3) during the execution; None where none was executed.
        tool_poses: Tool poses (T+1, M, 8) during the execution; None where none was executed.
        loss_before: Loss of leaving the state as it is.
        loss: Loss of the executed plan; `loss_before` where none was executed.
        gradient_evaluations: Gradient evaluations of this stage, all worlds.
        history: Every iteration of the optimiser, per round of candidates.
        seconds: Wall time of the parts `transport`, `placement`, `optimization`, `execution`, of further phases by their names
            (`refinement`), and `total`.
        rollouts: Rollouts without a gradient of this stage, all worlds, executions included.
        warm: What the objective can start from at the stage's end; None for a stage read from a record.
    """

    index: int
    status: Status
    state_before: State
    state: State
    priorities: Tensor
    candidates: tuple[Candidate, ...]
    best: int | None
    actions: Tensor | None
    positions: Tensor | None
    tool_poses: Tensor | None
    loss_before: float
    loss: float
    gradient_evaluations: int
    history: tuple[Iteration, ...]
    seconds: dict[str, float]
    rollouts: int = 0
    warm: tuple[object, ...] | None = dataclasses.field(default=None, repr=False, compare=False)


@dataclasses.dataclass(frozen=True)
class Revision:
    """Stages that a loop has given already, with other plans.

    Attributes:
        results: The stages as they are now, in order, up to the last one that was given. The first ones may be older than the run
            that revises them, where it goes on with a recorded one.
        reason: What changed them, e.g. ``"joint polish"``.
        complete: Whether this is all that was to come of it; False where it was interrupted.
    """

    results: tuple[StageResult, ...]
    reason: str
    complete: bool = True


@dataclasses.dataclass(frozen=True)
class DeformResult:
    """A whole run.

    Attributes:
        task: What was asked for.
        goal: Goal particles (M, 3), length units.
        stages: Every stage, in order.
        status: Status of the last stage.
        loss_initial: Loss before the first stage, objective units.
        loss_final: Loss after the last executed plan, objective units.
        metric_name: Name of the task's metric.
        metric_initial: Its value at the scene's start, also for a run that goes on from a record.
        metric_value: Its value at the end.
        gradient_evaluations: Gradient evaluations of all stages and worlds.
        rollouts: Rollouts without a gradient of all stages and worlds, executions included.
        seconds: Wall time of the run.
        names: Names or classes of the parts used: ``backend``, ``ot``, ``placer``, ``strategy``.
        seed: The seed.
    """

    task: Task
    goal: Tensor
    stages: tuple[StageResult, ...]
    status: Status
    loss_initial: float
    loss_final: float
    metric_name: str
    metric_initial: float
    metric_value: float
    gradient_evaluations: int
    rollouts: int
    seconds: float
    names: dict[str, str]
    seed: int

    @property
    def state(self) -> State:
        """State after the last stage, a single world."""
        return self.stages[-1].state

    @property
    def memory(self) -> MemoryUse | None:
        """Memory of the rollouts and gradients of the largest batch; None where no iteration measured it."""
        uses = [iteration.memory for stage in self.stages for iteration in stage.history if iteration.memory is not None]
        return max(uses, key=lambda use: (use.estimate, use.peak or 0), default=None)


class Observer:
    """Base of observers of a run; every method does nothing until overridden."""

    def run_started(self, task: Task, goal: Tensor, names: dict[str, str], seed: int) -> None:
        """The parts are ready and checked."""

    def part_started(self, stage: int, part: str) -> None:
        """A part of a stage begins: ``"transport"``, ``"placement"``, ``"execution"``, or a phase by its name."""

    def optimization_started(self, stage: int, worlds: int, memory_estimate: int) -> None:
        """A batch of candidates is about to be optimised; the estimate is that of a rollout and its gradient, bytes."""

    def iteration_finished(self, stage: int, iteration: Iteration) -> None:
        """One gradient evaluation of all candidates of a stage is done."""

    def stage_finished(self, result: StageResult) -> None:
        """A stage is done."""

    def stages_revised(self, revision: Revision) -> None:
        """Stages that were done have other plans now; what `stage_finished` told of them no longer counts."""

    def run_finished(self, result: DeformResult) -> None:
        """The run is done."""
