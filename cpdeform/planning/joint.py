"""Joint polish: one descent over the actions of several stages, each of which so far was found without knowing the next."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence

import torch

from cpdeform.core.memory_limit import check_memory
from cpdeform.core.placer import Candidate
from cpdeform.core.state import State
from cpdeform.planning.algorithm import Planner
from cpdeform.planning.chain import SimulatorChain, begin_stage
from cpdeform.planning.optimizer import Iteration, OptimizationResult, TrajectoryOptimizer
from cpdeform.planning.result import StageResult
from cpdeform.planning.workbench import is_finite

PHASE = "joint polish"


def polish_jointly(
    planner: Planner,
    results: Sequence[StageResult],
    optimizer: TrajectoryOptimizer,
) -> list[StageResult]:
    """Lower the loss at the end of several stages over the actions of all of them, and execute them anew.

    A stage that is planned alone is done when its own loss is low. Together they can prepare each other: the first one may leave
    clay where the second one takes it. An iteration costs a gradient a stage, and is counted so.

    Args:
        planner: The parts.
        results: Consecutive stages; those without a plan stay as they are.
        optimizer: How.

    Returns:
        The stages with their new plans; those given where nothing is gained.
    """
    planned = [result for result in results if result.actions is not None]
    if not planned:
        return list(results)
    begun = time.perf_counter()
    actions = torch.cat([result.actions for result in planned if result.actions is not None]).unsqueeze(0)
    found = _minimize(planner, planned, actions, optimizer)
    executed = _execute(planner, planned, found)
    if executed is None or not executed[-1].loss < planned[-1].loss:
        executed = planned
    seconds = (time.perf_counter() - begun) / len(planned)
    polished = iter([_accounted(result, seconds, found, last=result is executed[-1]) for result in executed])
    return [result if result.actions is None else next(polished) for result in results]


def _minimize(
    planner: Planner, planned: Sequence[StageResult], actions: torch.Tensor, optimizer: TrajectoryOptimizer
) -> OptimizationResult:
    """The descent, told to the observers as iterations of the last stage."""
    poses = torch.stack([_executed(result).proposal.pose for result in planned])
    chain = SimulatorChain(planner.simulator, poses=poses, rest_steps=planner.task.rest_steps)
    check_memory(chain, step_count=actions.shape[1], worlds=1)

    def tell(iteration: Iteration) -> None:
        for observer in planner.observers:
            observer.iteration_finished(planned[-1].index, dataclasses.replace(iteration, phase=PHASE))

    return optimizer.minimize(
        chain,
        planned[0].state_before,
        actions,
        planner.objective,
        warm=planned[-1].warm,
        executor=planner.executor,
        on_iteration=tell,
    )


def _execute(planner: Planner, planned: Sequence[StageResult], found: OptimizationResult) -> list[StageResult] | None:
    """Each stage executed with its new actions; None where one leaves the finite numbers."""
    state, loss, executed = planned[0].state_before, planned[0].loss_before, list[StageResult]()
    for result, actions in zip(planned, found.actions[0].chunk(len(planned)), strict=True):
        before = state
        start = begin_stage(planner.task.scene, state, _executed(result).proposal.pose, actions.unsqueeze(0))
        trajectory = planner.simulator.rollout(start, actions.unsqueeze(0))
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


def _with_plan(result: StageResult, start: State, actions: torch.Tensor, loss: float) -> tuple[Candidate, ...]:
    """The candidates of a stage, the executed one with its new plan."""
    proposal = dataclasses.replace(_executed(result).proposal, pose=start.tool_pose[0])
    changed = dataclasses.replace(_executed(result), proposal=proposal, actions=actions, loss=loss)
    return tuple(changed if number == result.best else candidate for number, candidate in enumerate(result.candidates))


def _executed(result: StageResult) -> Candidate:
    """The candidate that a stage executed."""
    assert result.best is not None
    return result.candidates[result.best]


def _accounted(result: StageResult, seconds: float, found: OptimizationResult, *, last: bool) -> StageResult:
    """A stage with its share of what the joint polish took; the last stage keeps its iterations."""
    iterations = [dataclasses.replace(iteration, phase=PHASE) for iteration in found.history] if last else []
    return dataclasses.replace(
        result,
        gradient_evaluations=result.gradient_evaluations + found.gradient_evaluations,
        history=(*result.history, *iterations),
        seconds={**result.seconds, PHASE: seconds, "total": result.seconds.get("total", 0.0) + seconds},
    )
