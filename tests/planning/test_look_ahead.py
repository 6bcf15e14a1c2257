"""The beam over stages: it may give up a stage's best plan for a better end."""

from __future__ import annotations

import pytest
import torch
from cpdeform_toy.parts import OTSolverToy, PlacerToy
from cpdeform_toy.simulator import SimulatorToy

from cpdeform.core.errors import InputError
from cpdeform.core.objective import Objective, ObjectiveResult
from cpdeform.core.task import load_task
from cpdeform.planning.algorithm import Planner
from cpdeform.planning.optimizer import TrajectoryOptimizer
from cpdeform.planning.phases.descent import PhaseDescent
from cpdeform.planning.result import Status
from cpdeform.planning.strategies.look_ahead import StrategyLookAhead

SPEEDS = (1.0, -1.0)
"""Directions of the two plans of a stage along x, in units of action."""


class PlacerTwoWays(PlacerToy):
    """Forward or backward."""

    def ask(self, stage):
        found = super().ask(stage)[:1] * 2
        return [
            type(item)(item.pose, item.score, f"way-{n}", n, torch.tensor([SPEEDS[n], 0.0, 0.0]).repeat(5, 1))
            for n, item in enumerate(found)
        ]


class Valley(Objective):
    """A loss of the body's place along x with a shallow valley ahead and a deep one behind, farther away."""

    def evaluate(self, trajectory, warm=None):
        place = trajectory.positions[:, -1, :, 0].mean(dim=1) - 0.4
        ahead, behind = (place - 0.1).abs(), (place + 0.2).abs()
        loss = torch.minimum(1.0 + 10.0 * ahead, 15.0 * behind - 0.2)
        return ObjectiveResult(loss=loss, grad_positions=torch.zeros_like(trajectory.positions))


@pytest.fixture
def task(toy_task_file):
    return load_task(toy_task_file)


def run(task, loop=None, *, stages=2):
    descent = PhaseDescent(optimizer=TrajectoryOptimizer(iterations=1))
    simulator = SimulatorToy(task.scene, batch_size=4)
    parts = {"ot_solver": OTSolverToy(), "placer": PlacerTwoWays(count=1), "objective": Valley(), "phases": (descent,)}
    return Planner(task=task, simulator=simulator, **parts, loop=loop).run(stages=stages)


def test_it_finds_the_end_that_greed_misses(task):
    greedy, ahead = run(task), run(task, StrategyLookAhead(width=2).loop)
    assert [stage.best for stage in greedy.stages] == [0, None]
    assert [stage.best for stage in ahead.stages] == [1, 1]
    assert ahead.loss_final < greedy.loss_final
    assert ahead.stages[0].loss > greedy.stages[0].loss
    first, second = ahead.stages
    assert torch.equal(second.state_before.position, first.state.position)
    # What was spent on the way that was given up counts.
    assert ahead.gradient_evaluations == 2 + 2 * 2


def test_a_beam_of_width_one_is_algorithm_1(task):
    greedy, narrow = run(task, stages=1), run(task, StrategyLookAhead(width=1).loop, stages=1)
    assert greedy.loss_final == narrow.loss_final
    assert (greedy.gradient_evaluations, greedy.rollouts) == (narrow.gradient_evaluations, narrow.rollouts)
    with pytest.raises(InputError, match="width: got 0"):
        StrategyLookAhead(width=0)


def test_where_nothing_gains_the_failure_is_told(task):
    parts = {"ot_solver": OTSolverToy(), "placer": PlacerToy(count=0), "objective": Valley()}
    descent = PhaseDescent(optimizer=TrajectoryOptimizer(iterations=1))
    made = Planner(task=task, simulator=SimulatorToy(task.scene), **parts, phases=(descent,), loop=StrategyLookAhead().loop)
    result = made.run(stages=3)
    assert [stage.status for stage in result.stages] == [Status.NO_PLACEMENT]
