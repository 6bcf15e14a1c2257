"""Phases: an entry in a list, whatever it does; screening without gradients, executors, what is counted."""

from __future__ import annotations

import dataclasses
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from cpdeform_toy.parts import OTSolverToy, PlacerToy
from cpdeform_toy.simulator import SimulatorToy

from cpdeform.core.errors import InputError
from cpdeform.core.task import load_task
from cpdeform.planning.algorithm import Planner
from cpdeform.planning.objectives.transport import ObjectiveTransport
from cpdeform.planning.optimizer import TrajectoryOptimizer
from cpdeform.planning.phases.descent import PhaseDescent, PhaseRefinement
from cpdeform.planning.phases.screening import PhaseScreening
from cpdeform.planning.pruner import PrunerHalving, PrunerNone, make_pruner
from cpdeform.planning.result import Status


class PlacerMoving(PlacerToy):
    """Proposals with first actions: the n-th one moves the tool n times as fast along x."""

    def ask(self, stage):
        found = super().ask(stage)
        speeds = [torch.tensor([0.2 * (number + 1), 0.0, 0.0]).repeat(5, 1) for number in range(len(found))]
        return [dataclasses.replace(item, actions=actions) for item, actions in zip(found, speeds, strict=True)]


@pytest.fixture
def task(toy_task_file):
    return load_task(toy_task_file)


def planner(task, phases, *, placer=None, batch_size=4, **options):
    return Planner(
        task=task,
        simulator=SimulatorToy(task.scene, batch_size=batch_size),
        ot_solver=OTSolverToy(),
        placer=placer or PlacerMoving(count=5, spacing=0.01),
        objective=ObjectiveTransport(OTSolverToy(), torch.as_tensor(task.load_goal()), scene=task.scene),
        phases=phases,
        **options,
    )


def test_screening_keeps_the_best_by_rollouts_alone(task):
    descent = PhaseDescent(optimizer=TrajectoryOptimizer(iterations=3, pruner=PrunerNone()))
    (stage,) = planner(task, (PhaseScreening(keep=2), descent)).run(stages=1).stages
    left_out = [candidate.loss == torch.inf for candidate in stage.candidates]
    # The goal is 0.1 away: the fastest two proposals come nearest, whatever batch they were in.
    assert left_out == [True, True, True, False, False]
    assert stage.gradient_evaluations == 2 * 3
    assert stage.rollouts == 5 + 1
    assert stage.status is Status.FINISHED
    assert stage.best in (3, 4)


def test_a_search_without_any_gradient(task):
    result = planner(task, (PhaseScreening(keep=1),)).run(stages=1)
    (stage,) = result.stages
    assert (result.gradient_evaluations, result.rollouts) == (0, 6)
    assert stage.best == 4
    assert torch.equal(stage.actions[:, 0], torch.full((5,), 1.0).to(stage.actions))
    assert stage.loss < stage.loss_before


def test_first_actions_of_a_proposal_are_where_its_descent_begins(task):
    descent = PhaseDescent(optimizer=TrajectoryOptimizer(iterations=1, initial_noise=0.3))
    (stage,) = planner(task, (descent,)).run(stages=1).stages
    for number, candidate in enumerate(stage.candidates):
        assert torch.allclose(candidate.actions[:, 0].float(), torch.full((5,), 0.2 * (number + 1)))


def test_descent_and_refinement_are_refused_alone(task):
    optimizer = TrajectoryOptimizer(iterations=2)
    objective = ObjectiveTransport(OTSolverToy(), torch.as_tensor(task.load_goal()))
    with pytest.raises(InputError, match="phases: got none that works on a round"):
        planner(task, (PhaseRefinement(objective=objective, optimizer=optimizer),)).run()
    with pytest.raises(InputError, match="keep: got 0"):
        PhaseScreening(keep=0)


class ExecutorBackwards:
    """Computes the last item first, in other threads."""

    width = 2

    def __init__(self):
        self.items = 0

    def map(self, function, items):
        self.items += len(items)
        with ThreadPoolExecutor(2) as pool:
            futures = [pool.submit(function, item) for item in reversed(items)]
            return [future.result() for future in reversed(futures)]


def test_where_batches_are_computed_changes_nothing(task):
    descent = PhaseDescent(optimizer=TrajectoryOptimizer(iterations=4, initial_noise=0.2))
    phases = (PhaseScreening(keep=4), descent)
    executor = ExecutorBackwards()
    here = planner(task, phases, batch_size=2).run().stages
    there = planner(task, phases, batch_size=2, executor=executor).run().stages
    # Three batches of a screening and at least two of a descent's first iteration, a stage.
    assert executor.items >= 2 * (3 + 2)
    for first, second in zip(here, there, strict=True):
        assert [candidate.loss for candidate in first.candidates] == [candidate.loss for candidate in second.candidates]
        assert torch.equal(first.actions, second.actions)


def test_halving_compares_all_candidates_of_a_round():
    active, losses = torch.arange(6), torch.tensor([6.0, 5.0, 4.0, 3.0, 2.0, 1.0], dtype=torch.float64)
    halving = PrunerHalving(least_iterations=1)
    assert halving.survivors(active, losses, done=1, iterations=16).tolist() == active.tolist()
    assert halving.survivors(active, losses, done=2, iterations=16).tolist() == [3, 4, 5]
    assert halving.survivors(active, losses, done=4, iterations=16).tolist() == [4, 5]
    assert halving.survivors(active, losses, done=8, iterations=16).tolist() == [5]
    assert PrunerHalving().survivors(active, losses, done=4, iterations=16).tolist() == active.tolist()
    assert PrunerNone().survivors(active, losses, done=15, iterations=16).tolist() == active.tolist()
    assert make_pruner("halving") == PrunerHalving()
    with pytest.raises(InputError, match=r'optimizer\.pruner: got "halfing".*Did you mean "halving"'):
        make_pruner("halfing")
