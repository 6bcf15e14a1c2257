"""A plan whose rollout was finite in the search and is not when it is executed."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from cpdeform_toy.parts import OTSolverToy, PlacerToy
from cpdeform_toy.simulator import SimulatorToy

from cpdeform.core.objective import Objective
from cpdeform.core.task import load_task
from cpdeform.planning.algorithm import Planner
from cpdeform.planning.objectives.transport import ObjectiveTransport
from cpdeform.planning.optimizer import TrajectoryOptimizer
from cpdeform.planning.phases.descent import PhaseDescent, PhaseRefinement
from cpdeform.planning.pruner import PrunerNone
from cpdeform.planning.result import Status


class SimulatorBrink(SimulatorToy):
    """Breaks in a world that is alone, whose sums on threads have another order; from the rollout `first` of that kind on."""

    def __init__(self, scene, *, spoilt, first=0, **options):
        super().__init__(scene, **options)
        self.spoilt, self.first = spoilt, first

    def rollout(self, state, actions):
        trajectory = super().rollout(state, actions)
        if state.batch_size > 1:
            return trajectory
        self.first -= 1
        if self.first >= 0:
            return trajectory
        if self.spoilt == "positions":
            positions = trajectory.positions.clone()
            positions[:, -1, 0] = torch.nan
            final = dataclasses.replace(trajectory.final_state, position=positions[:, -1])
            return dataclasses.replace(trajectory, positions=positions, final_state=final)
        spoilt = torch.full_like(getattr(trajectory.final_state, self.spoilt), torch.inf)
        return dataclasses.replace(trajectory, final_state=dataclasses.replace(trajectory.final_state, **{self.spoilt: spoilt}))


class Careful(ObjectiveTransport):
    """Says what it was asked about, as the transport solvers do."""

    def evaluate(self, trajectory, warm=None):
        assert torch.isfinite(trajectory.positions).all()
        return super().evaluate(trajectory, warm)


def run(task, simulator, *, objective=None, refinement=()):
    objective: Objective = objective or Careful(OTSolverToy(), torch.as_tensor(task.load_goal()), scene=task.scene)
    search = PhaseDescent(optimizer=TrajectoryOptimizer(iterations=3, pruner=PrunerNone()))
    parts = {"ot_solver": OTSolverToy(), "placer": PlacerToy(), "objective": objective, "phases": (search, *refinement)}
    return Planner(task=task, simulator=simulator, **parts).run(stages=1), objective


@pytest.mark.parametrize("spoilt", ["positions", "velocity", "elastic_strain"])
def test_the_stage_ends_non_finite_with_advice(toy_task_file, spoilt):
    task = load_task(toy_task_file)
    result, _ = run(task, SimulatorBrink(task.scene, batch_size=4, spoilt=spoilt))
    (stage,) = result.stages
    assert result.status is stage.status is Status.NON_FINITE
    assert "executed" in stage.status.advice
    assert (stage.best, stage.actions, stage.positions) == (None, None, None)
    assert torch.equal(stage.state.position, stage.state_before.position)
    assert all(torch.isfinite(getattr(stage.state, field.name)).all() for field in dataclasses.fields(stage.state))
    assert stage.loss == stage.loss_before == result.loss_final


def test_a_refined_plan_that_breaks_leaves_the_plan_as_it_was(toy_task_file):
    task = load_task(toy_task_file)
    plain, objective = run(task, SimulatorToy(task.scene, batch_size=4))
    optimizer = TrajectoryOptimizer(iterations=4)
    refinement = (PhaseRefinement(objective=objective, optimizer=optimizer),)
    better, _ = run(task, SimulatorToy(task.scene, batch_size=4), objective=objective, refinement=refinement)
    assert better.loss_final < plain.loss_final
    # the execution and the iterations of the refinement go well, the execution of the refined plan does not
    simulator = SimulatorBrink(task.scene, batch_size=4, spoilt="positions", first=1 + optimizer.iterations)
    refined, _ = run(task, simulator, objective=objective, refinement=refinement)
    assert refined.status is Status.FINISHED
    assert refined.loss_final == pytest.approx(plain.loss_final)
    assert torch.equal(refined.stages[0].actions, plain.stages[0].actions)
