"""Sculpting by many touches: drawn, screened by rollouts, varied, and the best of them polished by gradients."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any, ClassVar

from torch import Tensor

from cpdeform.core.errors import InputError
from cpdeform.core.final_gradient import takes_final_gradient
from cpdeform.core.objective import Objective
from cpdeform.core.simulator import Simulator
from cpdeform.core.state import State
from cpdeform.core.task import Task
from cpdeform.planning.algorithm import Planner, Start
from cpdeform.planning.coarse import CoarseModel
from cpdeform.planning.effort import Effort, JointEffort
from cpdeform.planning.interrupted import StageInterrupted, StagesInterrupted
from cpdeform.planning.joint import PHASE as JOINT_POLISH
from cpdeform.planning.joint import polish_jointly
from cpdeform.planning.objectives.shape import ObjectiveShape
from cpdeform.planning.optimizer import TrajectoryOptimizer
from cpdeform.planning.phases.phase import Phase
from cpdeform.planning.phases.polish import PhasePolish
from cpdeform.planning.phases.screening import PhaseScreening
from cpdeform.planning.pruner import PrunerNone
from cpdeform.planning.rest import rest, settle_goal
from cpdeform.planning.result import Revision, StageResult, Status
from cpdeform.planning.strategy import Parts, Strategy
from cpdeform.planning.taken_up import taken_up

MOST_CELLS, LEAST_SELF_IOU = 1.0, 0.9
"""How far a goal may fall and how much of its shape it has to keep to count as one at rest that hangs a little."""

JOINT_DESCENT: Mapping[str, Any] = MappingProxyType({"warm_up": 3, "backtrack": 10, "leap": 0.05})
"""How joint descents go: gently at first, and back at once where the loss leaps."""

JOINT_STEP, LARGEST_JOINT_STEP = 0.24, 0.06
"""Adam's step size in a joint descent, times the number of stages, and the largest one, units of action. A row of stages errs
together: the longer it is, the more of what the touches have gained a step undoes."""

LONGEST_JOINT_DESCENT, FEW_STAGES = 80, 6
"""The most iterations of a joint descent, and the stages below which it has more of them, for the same gradients: over six stages
there is little to gain after 80, over three there still is."""

WORTH_GOING_ON = 0.02
"""Share of the loss that the joint descent after stages without a gain has to take off for the run to go on."""

SCREENED = 10_000
"""Candidates that screening leaves to the next phases: all, since it is all rounds together that the best are chosen from."""


class StrategySculpt(Strategy):
    """Each stage is one touch, the best of many; a few of them at a time are then polished together.

    A stage draws random touches, judges each by one rollout, varies the best, and polishes the best of all by gradients, in two
    steps, over their actions and over where their tools begin (`cpdeform.planning.placed`). The loss is transport and misplaced
    mass. The clay is let to rest before the first touch. Where no touch gains, others are drawn, a few times in a row.

    A touch that is planned alone serves its own loss. Once a few are found, one descent lowers the loss at their end over the
    actions and placements of all (`cpdeform.planning.joint`), as far as the simulator's gradients can be chained: these stages are
    then given once more, revised.

    Args:
        touches: Random touches of a stage.
        variations: Touches of each of two rounds of variations.
        polished: Candidates of the first step of polishing, in which all kinds of touches take their turn, and of the second.
        iterations: Gradient evaluations of each of them in these steps.
        together: Stages that are polished together.
        joint_gradients: The most gradient evaluations of that descent, of all these stages together; see `LONGEST_JOINT_DESCENT`.
        joint_every: Stages after which those found so far are polished together on the way.
        interim_gradients: The most gradient evaluations of that, of all of them together.
        coarse: Whether touches are screened with fewer particles, where there are many; see `cpdeform.planning.coarse`.
        idle: Stages without a gain in a row after which the run ends, unless the joint descent that follows gains.

    Raises:
        InputError: An option is out of range.
    """

    takes_optimizer: ClassVar[bool] = False

    def __init__(
        self,
        *,
        touches: int = 96,
        variations: int = 32,
        polished: tuple[int, int] = (10, 2),
        iterations: tuple[int, int] = (4, 8),
        together: int = 12,
        joint_gradients: int = 960,
        joint_every: int = 3,
        interim_gradients: int = 120,
        coarse: bool = True,
        idle: int = 3,
    ) -> None:
        numbers = {"touches": touches, "variations": variations, "idle": idle}
        numbers |= {"together": together, "joint_gradients": joint_gradients}
        numbers |= {"joint_every": joint_every, "interim_gradients": interim_gradients}
        numbers |= {"polished": min(polished), "iterations": min(iterations)}
        for name, number in numbers.items():
            if number < 1:
                raise InputError(name, came=str(number), expected="at least 1")
        self.touches, self.variations, self.idle = touches, variations, idle
        self.polished, self.iterations = tuple(polished), tuple(iterations)
        self.together, self.joint_every, self.coarse = together, joint_every, coarse
        self._interim, self._joint = interim_gradients, joint_gradients

    def settings(self, task: Task, *, placer: str | None) -> Mapping[str, Any]:
        """The placer of touches, and the loss that sees crumbs."""
        settings: dict[str, Any] = {"placer": "touch", "objective": {"kind": "shape", "points": 3000, "blur": 4e-3}}
        if placer in (None, "touch"):
            settings["placer_options"] = {"count": self.touches, "variations": self.variations}
        return settings

    def phases(self, parts: Parts) -> tuple[Phase, ...]:
        """Screening of each round, then two steps of polishing of the best of all."""
        rates = (0.15, 0.08)
        steps = zip(self.polished, self.iterations, rates, strict=True)
        optimizers = [
            (keep, TrajectoryOptimizer(iterations=count, learning_rate=rate, pruner=PrunerNone(), backtrack=3))
            for keep, count, rate in steps
        ]
        return (
            PhaseScreening(keep=SCREENED),
            *(
                PhasePolish(keep=keep, optimizer=optimizer, exclusive=number == 0, each_kind=number == 0, placing=True)
                for number, (keep, optimizer) in enumerate(optimizers)
            ),
        )

    def effort(self, stage: Effort) -> Effort:
        """See `Strategy`; each stage leaves the clay alone once, to see what its plan has to be better than."""
        return stage + Effort(rollouts=(1, 1))

    def objective(self, objective: Objective, *, simulator: Simulator, goal: Tensor) -> Objective:
        """See `Strategy`; it measures from rest to rest."""
        first = rest(simulator, simulator.initial_state(batch_size=1)).state
        return _from_rest(objective, first, _settled(simulator, goal))

    def joint_efforts(self, simulator: Simulator, *, stages: int) -> tuple[JointEffort, ...]:
        """See `Strategy`."""
        return self.joint_descents(stages) if takes_final_gradient(simulator) else ()

    def joint_descents(self, stages: int) -> tuple[JointEffort, ...]:
        """The joint descents of a run in which every stage finds a plan; each goes over all stages since the last chapter.

        Args:
            stages: Stages of the run.

        Returns:
            In the order in which they come.
        """
        efforts = []
        for chapter in _parts(range(stages), self.together):
            for part in _parts(chapter, self.joint_every):
                last = part[-1] == chapter[-1]
                count = part[-1] + 1 - chapter[0]
                optimizer = joint_optimizer(stages=count, gradients=self._joint if last else self._interim)
                efforts.append(JointEffort(after=part[-1] + 1, stages=count, iterations=optimizer.effort(1).gradients))
        return tuple(efforts)

    def loop(self, planner: Planner, start: Start) -> Iterator[StageResult | Revision]:
        """One touch a stage, from rest to rest, some polished together; a few stages without a gain do not end the run."""
        planner, start = from_rest(planner, start)
        if self.coarse:
            planner = screened_coarsely(planner)
        before = taken_up(planner, start)
        if before:
            start = dataclasses.replace(start, previous=())
        finished: list[StageResult] = []
        first, end = start.first_stage - len(before), start.first_stage + start.stages
        # Of the stages before the last joint descent that brought a gain it no longer counts that they had none.
        counted = self._counted(before)
        for stages in _parts(range(first, end), self.together):
            held = before[stages.start - first : stages.stop - first]
            due = self._is_due(held, finished, stages, counted)
            while due or len(held) < len(stages):
                rest = range(0) if due else self._next(stages, len(held))
                for result in self._touches(planner, start, rest, [*finished, *held], counted):
                    held.append(result)
                    yield result
                due, over = False, self._is_over([*finished, *held], counted)
                last = over or len(held) == len(stages)
                loss = held[-1].loss
                for revision in self._polished(planner, held, self._joint if last else self._interim):
                    held = list(revision.results)
                    yield revision
                if over and (held[-1].status is Status.NON_FINITE or loss - held[-1].loss < WORTH_GOING_ON * loss):
                    return
                if over:
                    counted = len(finished) + len(held)
            finished += held

    def _counted(self, before: Sequence[StageResult]) -> int:
        """The stages of a run that goes on before the last joint descent that let it go on although they had no gain."""
        counted = 0
        for done in range(1, len(before) + 1):
            went_on = done < len(before) or JOINT_POLISH in before[-1].seconds
            if went_on and self._is_over(before[:done], counted):
                counted = done
        return counted

    def _is_due(self, held: Sequence[StageResult], finished: Sequence[StageResult], stages: range, counted: int) -> bool:
        """Whether a joint descent comes next in a run that goes on: the stages up to it are found, and it was not made."""
        if not held or JOINT_POLISH in held[-1].seconds:
            return False
        return len(held) in (len(stages), self._next(stages, len(held) - 1).stop - stages.start) or self._is_over(
            [*finished, *held], counted
        )

    def _next(self, stages: range, done: int) -> range:
        """The stages up to the next joint descent."""
        return stages[done : (done // self.joint_every + 1) * self.joint_every]

    def _polished(self, planner: Planner, held: list[StageResult], gradients: int) -> Iterator[Revision]:
        """The stages polished together, where the simulator can; nothing where no stage has a plan."""
        planned = sum(result.actions is not None for result in held)
        if not (planned and takes_final_gradient(planner.simulator)):
            return
        optimizer = joint_optimizer(stages=planned, gradients=gradients)
        try:
            yield Revision(tuple(polish_jointly(planner, held, optimizer)), JOINT_POLISH)
        except StagesInterrupted as interruption:
            yield Revision(interruption.results, JOINT_POLISH, complete=False)
            raise

    def _touches(
        self, planner: Planner, start: Start, stages: range, finished: Sequence[StageResult], counted: int
    ) -> Iterator[StageResult]:
        """Stages one after the other, each by itself; an interrupted one, too, before the interruption goes on."""
        before = list(finished)
        for index in stages:
            state, warm = (before[-1].state, before[-1].warm) if before else (start.state, planner.warm_at(start))
            try:
                before.append(planner.stage(start, index, state, before, warm=warm))
            except StageInterrupted as interruption:
                yield interruption.result
                raise
            yield before[-1]
            if self._is_over(before, counted):
                return

    def _is_over(self, results: Sequence[StageResult], counted: int) -> bool:
        """Whether the last stages, from number `counted` on, gained nothing, or the last one broke."""
        last = results[counted:][-self.idle :]
        stuck = len(last) == self.idle and all(result.status is not Status.FINISHED for result in last)
        return stuck or results[-1].status is Status.NON_FINITE


def joint_optimizer(*, stages: int, gradients: int) -> TrajectoryOptimizer:
    """The optimiser of a joint descent over a number of stages; an iteration costs a gradient a stage.

    Patience does not end it: where large steps gain nothing more, the smaller ones of its second half still do.
    """
    most = LONGEST_JOINT_DESCENT * max(FEW_STAGES, stages)
    iterations = max(1, min(gradients, most) // stages)
    rate = min(LARGEST_JOINT_STEP, JOINT_STEP / stages)
    options = {"iterations": iterations, "patience": iterations, "learning_rate": rate, **JOINT_DESCENT}
    return TrajectoryOptimizer(pruner=PrunerNone(), annealed=True, **options)


def _parts(stages: range, size: int) -> list[range]:
    """Stages in rows of at most `size`."""
    return [stages[first : first + size] for first in range(0, len(stages), size)]


def screened_coarsely(planner: Planner) -> Planner:
    """A planner whose screening goes by fewer particles, where there are many and the loss is made for it."""
    objective = planner.objective
    model = CoarseModel.of(planner.simulator, objective) if isinstance(objective, ObjectiveShape) else None
    phases = [dataclasses.replace(phase, coarse=model) if isinstance(phase, PhaseScreening) else phase for phase in planner.phases]
    return dataclasses.replace(planner, phases=phases)


def from_rest(planner: Planner, start: Start) -> tuple[Planner, Start]:
    """A run whose clay has come to rest before the first stage, and whose goal lies where clay of its shape rests.

    The loss is measured from there. Without it the first stages would be paid for falling, and the goal could not be met.

    Args:
        planner: The parts.
        start: Where the run would begin.

    Returns:
        Planner and start, changed. A goal that clay does not keep, such as one in the air, stays where it is, as does the state of
        a run that goes on.
    """
    simulator = planner.simulator
    first = rest(simulator, simulator.initial_state(batch_size=1)).state
    goal = _settled(simulator, start.goal)
    objective = _from_rest(planner.objective, first, goal)
    state = start.state if start.previous or start.first_stage else first
    planner = dataclasses.replace(planner, objective=objective, compared_with_rest=True)
    return planner, dataclasses.replace(start, state=state, goal=goal)


def _from_rest(objective: Objective, first: State, goal: Tensor) -> Objective:
    """The loss from a start at rest, a single world, to a goal (M, 3) at rest."""
    return objective.rebased(goal=goal, start=first.position[0]) if isinstance(objective, ObjectiveShape) else objective


def _settled(simulator: Simulator, goal: Tensor) -> Tensor:
    """The goal's particles (M, 3) where clay of its shape rests."""
    if len(goal) != simulator.scene.particle_count:
        return goal
    settled = settle_goal(simulator, goal)
    near = 0.0 <= settled.drop <= MOST_CELLS / simulator.scene.grid_size
    return settled.position.to(goal) if near and settled.self_iou >= LEAST_SELF_IOU else goal
