"""Joint polish: one descent over the actions of several stages, each of which so far was found without knowing the next."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence

import torch
from torch import Tensor

from cpdeform.core.memory_limit import check_memory
from cpdeform.core.placer import Candidate
from cpdeform.core.state import State
from cpdeform.planning.algorithm import Planner
from cpdeform.planning.chain import SimulatorChain
from cpdeform.planning.interrupted import StagesInterrupted
from cpdeform.planning.optimizer import Iteration, TrajectoryOptimizer
from cpdeform.planning.placed import Placing
from cpdeform.planning.race import Race
from cpdeform.planning.result import StageResult
from cpdeform.planning.stage_start import begin_stage
from cpdeform.planning.workbench import is_finite

PHASE = "joint polish"


def polish_jointly(planner: Planner, results: Sequence[StageResult], optimizer: TrajectoryOptimizer) -> list[StageResult]:
    """Lower the loss at the end of several stages over the actions and placements of all of them, and execute them anew.

    A stage that is planned alone is done when its own loss is low. Together they can prepare each other: the first one may leave
    clay where the second one takes it. An iteration costs a gradient a stage, and is counted so.

    Args:
        planner: The parts.
        results: Consecutive stages; those without a plan stay without one.
        optimizer: How.

    Returns:
        The stages with their new plans; those given where nothing is gained.

    Raises:
        CapabilityError: The simulator's gradients cannot be chained.
        InputError: There is not enough memory.
        StagesInterrupted: A `KeyboardInterrupt` came; it holds the stages with the best plans so far.
    """
    planned = [result for result in results if result.actions is not None]
    if not planned:
        return list(results)
    begun = time.perf_counter()
    found = _minimize(planner, planned, optimizer)
    executed = _execute(planner, planned, found.actions) if found.gained else None
    if executed is None:
        executed = planned
    seconds = (time.perf_counter() - begun) / len(planned)
    polished = iter([_accounted(result, seconds, found, last=result is executed[-1]) for result in executed])
    final: list[StageResult] = []
    for result in results:
        final.append(_idle_after(result, final) if result.actions is None else next(polished))
    if found.interruption is not None:
        raise StagesInterrupted(final) from found.interruption
    return final


@dataclasses.dataclass(frozen=True)
class _Descent:
    """What a descent came to, if only up to an interruption.

    Attributes:
        actions: Best actions (K (rows + T), A) of K stages, one after the other, each after the rows that place its tools.
        gradients: Gradients of each stage.
        history: Its iterations.
        interruption: What broke it off; None for nothing.
    """

    actions: Tensor
    gradients: int
    history: tuple[Iteration, ...]
    interruption: KeyboardInterrupt | None = None

    @property
    def gained(self) -> bool:
        """Whether the best plan is better than the first one, by the loss of the whole row: its end and what its way costs."""
        return bool(self.history) and bool(self.history[-1].best_loss[0] < self.history[0].loss[0])


def _minimize(planner: Planner, planned: Sequence[StageResult], optimizer: TrajectoryOptimizer) -> _Descent:
    """The descent, told to the observers as iterations of the last stage."""
    poses = torch.stack([_executed(result).proposal.pose for result in planned])
    placing = Placing(scene=planner.task.scene)
    actions = torch.cat([placing.before(result.actions) for result in planned if result.actions is not None])
    chain = SimulatorChain(planner.simulator, poses=poses, rest_steps=planner.task.rest_steps, placing=placing)
    check_memory(chain, step_count=len(actions), worlds=1)
    last, history, races = planned[-1], list[Iteration](), list[Race]()

    def note(iteration: Iteration) -> None:
        history.append(dataclasses.replace(iteration, phase=PHASE))
        planner.tell_iteration(last.index, history[-1])

    planner.tell_part(last.index, PHASE)
    planner.tell_batch(last.index, 1, chain.memory_estimate(len(actions), worlds=1))
    interruption = None
    try:
        optimizer.minimize(
            chain,
            planned[0].state_before,
            actions.unsqueeze(0),
            planner.objective,
            warm=last.warm,
            executor=planner.executor,
            on_iteration=note,
            on_start=races.append,
        )
    except KeyboardInterrupt as came:
        if not races:
            raise
        interruption = came
    return _Descent(races[0].best_actions[0], races[0].evaluations, tuple(history), interruption)


def _execute(planner: Planner, planned: Sequence[StageResult], plan: Tensor) -> list[StageResult] | None:
    """Each stage executed with its new rows and actions out of (K (rows + T), A); None where one leaves the finite numbers."""
    placing = Placing(scene=planner.task.scene)
    state, loss, executed = planned[0].state_before, planned[0].loss_before, list[StageResult]()
    for result, part in zip(planned, plan.unsqueeze(0).chunk(len(planned), dim=1), strict=True):
        before = state
        rows, actions = placing.split(part)
        poses = placing.placed(_executed(result).proposal.pose.to(rows).unsqueeze(0), rows)
        start = begin_stage(planner.task.scene, state, poses, actions)
        trajectory = planner.simulator.rollout(start, actions)
        if not is_finite(trajectory):
            return None
        evaluated = planner.objective.evaluate(trajectory)
        loss_before, loss, state = loss, float(evaluated.loss[0]), trajectory.final_state
        executed.append(
            dataclasses.replace(
                result,
                state_before=before,
                state=state,
                actions=trajectory.actions[0],
                positions=trajectory.positions[0],
                tool_poses=trajectory.tool_poses[0],
                candidates=_with_plan(result, start, trajectory.actions[0], loss),
                loss_before=loss_before,
                loss=loss,
                warm=evaluated.warm,
                rollouts=result.rollouts + 1,
            )
        )
    return executed


def _idle_after(result: StageResult, before: Sequence[StageResult]) -> StageResult:
    """A stage without a plan, where the stages before it may have ended elsewhere; it took no part, and says so."""
    result = dataclasses.replace(result, seconds={PHASE: 0.0, **result.seconds})
    if not before:
        return result
    last = before[-1]
    return dataclasses.replace(
        result, state_before=last.state, state=last.state, loss_before=last.loss, loss=last.loss, warm=last.warm
    )


def _with_plan(result: StageResult, start: State, actions: Tensor, loss: float) -> tuple[Candidate, ...]:
    """The candidates of a stage, the executed one with its new plan."""
    proposal = dataclasses.replace(_executed(result).proposal, pose=start.tool_pose[0])
    changed = dataclasses.replace(_executed(result), proposal=proposal, actions=actions, loss=loss)
    return tuple(changed if number == result.best else candidate for number, candidate in enumerate(result.candidates))


def _executed(result: StageResult) -> Candidate:
    """The candidate that a stage executed."""
    assert result.best is not None
    return result.candidates[result.best]


def _accounted(result: StageResult, seconds: float, found: _Descent, *, last: bool) -> StageResult:
    """A stage with its share of what the joint polish took; the last stage keeps its iterations."""
    return dataclasses.replace(
        result,
        gradient_evaluations=result.gradient_evaluations + found.gradients,
        history=(*result.history, *(found.history if last else ())),
        seconds={**result.seconds, PHASE: seconds, "total": result.seconds.get("total", 0.0) + seconds},
    )
