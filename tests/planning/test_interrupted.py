"""An interrupted stage keeps the best plan so far."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from cpdeform_toy.parts import OTSolverToy, PlacerToy
from cpdeform_toy.simulator import SimulatorToy

from cpdeform.core.objective import ObjectiveAutograd
from cpdeform.core.task import load_task
from cpdeform.planning.algorithm import Planner
from cpdeform.planning.interrupted import StageInterrupted
from cpdeform.planning.objectives.transport import ObjectiveTransport
from cpdeform.planning.optimizer import TrajectoryOptimizer
from cpdeform.planning.phases.descent import REFINEMENT, PhaseDescent, PhaseRefinement
from cpdeform.planning.pruner import PrunerNone
from cpdeform.planning.result import Observer, Status
from cpdeform.planning.stage_parts import failed_contacts
from cpdeform.planning.strategies.look_ahead import StrategyLookAhead


class Interrupt(Observer):
    """Interrupts after a number of iterations of a stage, as control-C would, and keeps what it is told of the stages."""

    def __init__(self, iterations, *, stage=0, phase="search"):
        self.left, self.stage, self.phase, self.told = iterations, stage, phase, []

    def optimization_started(self, stage, worlds, memory_estimate):
        self._check(stage)

    def iteration_finished(self, stage, iteration):
        self.left -= stage == self.stage and iteration.phase == self.phase
        self._check(stage)

    def stage_finished(self, result):
        self.told.append(result)

    def _check(self, stage):
        if stage == self.stage and self.left == 0:
            raise KeyboardInterrupt


class Offset(ObjectiveAutograd):
    """Squared distance of the final centre of mass from a point."""

    def __init__(self, point):
        self.point = point

    def loss(self, positions, tool_poses):
        return (positions[:, -1].mean(dim=1) - self.point.to(positions)).square().sum(dim=-1)


@pytest.fixture
def task(toy_task_file):
    return load_task(toy_task_file)


def planner(task, *, iterations=10, placer=None, simulator=None, phases=(), **options):
    optimizer = TrajectoryOptimizer(iterations=iterations, pruner=PrunerNone())
    return Planner(
        task=task,
        simulator=simulator or SimulatorToy(task.scene, batch_size=4),
        ot_solver=OTSolverToy(),
        placer=placer or PlacerToy(),
        objective=ObjectiveTransport(OTSolverToy(), torch.as_tensor(task.load_goal()), scene=task.scene),
        phases=(PhaseDescent(optimizer=optimizer), *phases),
        **options,
    )


def interrupted(task, interrupt, *, stages=2, **options):
    with pytest.raises(StageInterrupted) as caught:
        planner(task, observers=(interrupt,), **options).run(stages=stages)
    assert isinstance(caught.value.__cause__, KeyboardInterrupt)
    assert interrupt.told[-1] is caught.value.result
    return caught.value.result


@pytest.mark.parametrize("iterations", [2, 5])
@pytest.mark.parametrize("stage", [0, 1])
def test_the_plan_is_that_of_a_shorter_descent(task, iterations, stage):
    """Without a pruner the first iterations do not depend on how many were planned."""
    interrupt = Interrupt(iterations, stage=stage)
    result = interrupted(task, interrupt)
    assert [told.status for told in interrupt.told] == [Status.FINISHED] * stage + [Status.INTERRUPTED]
    start = {"state": result.state_before, "first_stage": stage}
    shorter = planner(task, iterations=iterations).run(stages=1, **start).stages[0]
    assert result.loss == shorter.loss < result.loss_before
    assert (result.index, result.best) == (shorter.index, shorter.best)
    assert torch.equal(result.actions, shorter.actions)
    assert torch.equal(result.positions, shorter.positions)
    for field in dataclasses.fields(result.state):
        assert torch.equal(getattr(result.state, field.name), getattr(shorter.state, field.name))
    assert [item.loss for item in result.candidates] == [item.loss for item in shorter.candidates]
    assert result.gradient_evaluations == shorter.gradient_evaluations
    assert result.rollouts == 1
    assert len(result.history) == iterations
    assert set(result.seconds) == set(shorter.seconds)


def test_the_best_of_all_rounds_is_kept(task):
    """The first round is over, the second one has hardly begun: the first one's plan is the better one."""
    first = planner(task).run(stages=1).stages[0]
    result = interrupted(task, Interrupt(12), placer=PlacerToy(rounds=2))
    assert result.loss == first.loss
    assert torch.equal(result.actions, first.actions)
    assert len(result.candidates) == 2 * len(first.candidates)


@pytest.mark.parametrize("iterations", [0, 1])
def test_without_a_plan_there_is_no_stage(task, iterations):
    """Before the first iteration, or after one that only broke."""
    interrupt = Interrupt(iterations)
    simulator = SimulatorToy(task.scene, batch_size=4, break_above=-2.0)
    with pytest.raises(KeyboardInterrupt) as caught:
        planner(task, observers=(interrupt,), simulator=simulator).run()
    assert type(caught.value) is KeyboardInterrupt
    assert interrupt.told == []


def test_a_simulator_that_cannot_go_on_hides_no_interruption(task):
    class Broken(SimulatorToy):
        def rollout(self, state, actions):
            if state.batch_size == 1:
                raise RuntimeError("lost")
            return super().rollout(state, actions)

    interrupt = Interrupt(5)
    with pytest.raises(KeyboardInterrupt):
        planner(task, observers=(interrupt,), simulator=Broken(task.scene, batch_size=4)).run()
    assert interrupt.told == []


def test_refinement_keeps_what_it_gained(task):
    point = torch.as_tensor(task.load_goal()).mean(dim=0)
    phase = PhaseRefinement(objective=Offset(point), optimizer=TrajectoryOptimizer(iterations=8, learning_rate=0.02))
    plain = planner(task, iterations=2).run(stages=1).stages[0]
    result = interrupted(task, Interrupt(4, phase=REFINEMENT), iterations=2, phases=(phase,))
    at_once = interrupted(task, Interrupt(1, phase=REFINEMENT), iterations=2, phases=(phase,))
    assert result.loss < plain.loss
    assert result.candidates[result.best].loss == result.loss
    assert torch.equal(at_once.actions, plain.actions)
    assert len(result.candidates) == len(plain.candidates)


def test_interrupted_candidates_may_be_tried_again(task):
    result = interrupted(task, Interrupt(2))
    little = dataclasses.replace(result, loss=result.loss_before * (1.0 - 1e-9))
    assert failed_contacts([little]) == ()
    assert failed_contacts([dataclasses.replace(little, status=Status.FINISHED)]) != ()


@pytest.mark.parametrize("stage", [0, 1])
def test_looking_ahead_keeps_its_best_path(task, stage):
    interrupt = Interrupt(5, stage=stage)
    with pytest.raises(KeyboardInterrupt):
        planner(task, observers=(interrupt,), loop=StrategyLookAhead(width=2).loop).run(stages=2)
    assert [told.index for told in interrupt.told] == list(range(stage + 1))
    assert interrupt.told[-1].status is Status.INTERRUPTED
    for before, after in zip(interrupt.told, interrupt.told[1:], strict=False):
        assert torch.equal(before.state.position, after.state_before.position)
    assert interrupt.told[-1].loss < interrupt.told[0].loss_before
