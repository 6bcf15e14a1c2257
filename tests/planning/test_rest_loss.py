"""Plans are compared with leaving the clay alone where it moves by itself."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from cpdeform_toy.parts import OTSolverToy, PlacerToy
from cpdeform_toy.simulator import SimulatorToy

from cpdeform.core.objective import ObjectiveAutograd
from cpdeform.core.task import load_task
from cpdeform.planning.algorithm import Planner
from cpdeform.planning.optimizer import TrajectoryOptimizer
from cpdeform.planning.phases.descent import PhaseDescent
from cpdeform.planning.pruner import PrunerNone
from cpdeform.planning.result import Status

DRIFT = 0.02


class SimulatorDrifting(SimulatorToy):
    """The toy, and a body that moves away along x by itself, by `DRIFT` a step."""

    def rollout(self, state, actions):
        found = super().rollout(state, actions)
        positions = found.positions.clone()
        positions[..., 0] -= DRIFT * torch.arange(positions.shape[1])[None, :, None]
        final = dataclasses.replace(found.final_state, position=positions[:, -1])
        return dataclasses.replace(found, positions=positions, final_state=final)


class Far(ObjectiveAutograd):
    """Distance of the centre of mass from a point far to the right."""

    def loss(self, positions, tool_poses):
        return 10.0 - positions[:, -1].mean(dim=1)[..., 0]


@pytest.fixture
def task(make_toy_task):
    return load_task(make_toy_task(stage_count=2, step_count=5))


def planner(task, **options):
    return Planner(
        task=task,
        simulator=SimulatorDrifting(task.scene, batch_size=4),
        ot_solver=OTSolverToy(),
        placer=PlacerToy(),
        objective=Far(),
        phases=(PhaseDescent(optimizer=TrajectoryOptimizer(iterations=6, pruner=PrunerNone())),),
        **options,
    )


def test_a_plan_that_is_better_than_rest_counts(task):
    kept = planner(task, compared_with_rest=True).run(stages=2).stages
    lost = planner(task).run(stages=2).stages
    assert [result.status for result in lost] == [Status.NO_IMPROVEMENT]
    assert [result.status for result in kept] == [Status.FINISHED] * 2
    first = kept[0]
    # The loss before is that of the state as it is; the plan is worse than that and better than nothing.
    alone = first.loss_before + DRIFT * task.rollout_steps
    assert first.loss_before < first.loss < alone
    assert first.rollouts == 2
    assert kept[1].loss_before == pytest.approx(first.loss)


def test_where_nothing_moves_it_makes_no_difference(task):
    still = dataclasses.replace(planner(task), simulator=SimulatorToy(task.scene, batch_size=4))
    found, expected = (dataclasses.replace(still, compared_with_rest=rests).run(stages=1).stages[0] for rests in (True, False))
    assert torch.equal(found.actions, expected.actions)
    assert (found.loss, found.loss_before, found.status) == (expected.loss, expected.loss_before, expected.status)
    assert found.rollouts == expected.rollouts + 1
