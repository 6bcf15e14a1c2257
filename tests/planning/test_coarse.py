"""Stages that are planned with fewer particles and executed with all, on the toy simulator."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from cpdeform_toy.parts import OTSolverToy, PlacerToy
from cpdeform_toy.simulator import SimulatorToy

from cpdeform.core.goal import write_goal
from cpdeform.core.sampling import sample_particles
from cpdeform.core.task import load_task
from cpdeform.planning.algorithm import Planner, Start
from cpdeform.planning.coarse import PARTICLES_PER_CELL, CoarseModel, CoarsePlanner, coarsening
from cpdeform.planning.interrupted import StageInterrupted
from cpdeform.planning.objectives.shape import ObjectiveShape
from cpdeform.planning.objectives.transport import ObjectiveTransport
from cpdeform.planning.optimizer import TrajectoryOptimizer
from cpdeform.planning.phases.descent import PhaseDescent
from cpdeform.planning.pruner import PrunerNone
from cpdeform.planning.result import Observer, Status

BODY = {"kind": "box", "position": [0.4, 0.2, 0.5], "widths": [0.1, 0.1, 0.1], "particle_count": 900}
SCENE = {
    "bodies": [BODY, {**BODY, "position": [0.4, 0.4, 0.5], "particle_count": 901}],
    "tools": [{"kind": "Sphere", "radius": 0.05, "position": [0.25, 0.3, 0.5], "action_scale": [0.01, 0.01, 0.01]}],
}


POLISH = TrajectoryOptimizer(iterations=2, learning_rate=0.05, pruner=PrunerNone())


@pytest.fixture
def task(make_toy_task):
    task = load_task(make_toy_task(scene=SCENE, stage_count=2, step_count=5))
    write_goal(task.goal, sample_particles(task.scene) + np.array([0.05, 0.0, 0.0]))
    return task


def planner(task, **options):
    goal, start = torch.as_tensor(task.load_goal()), torch.as_tensor(sample_particles(task.scene))
    transport = ObjectiveTransport(OTSolverToy(), goal, scene=task.scene)
    return Planner(
        task=task,
        simulator=SimulatorToy(task.scene, batch_size=4),
        ot_solver=OTSolverToy(),
        placer=PlacerToy(),
        objective=ObjectiveShape(transport, task.scene, goal, start),
        phases=(PhaseDescent(optimizer=TrajectoryOptimizer(iterations=4, pruner=PrunerNone())),),
        **options,
    )


def beginning(parts):
    state = parts.simulator.initial_state(batch_size=1)
    goal = torch.as_tensor(parts.task.load_goal()).to(state.position)
    return Start(state=state, goal=goal, first_stage=0, stages=2)


def test_every_second_particle_of_each_body_is_kept(task):
    simulator = SimulatorToy(task.scene, batch_size=3)
    model = CoarseModel.of(simulator)
    assert coarsening(task.scene) == 2
    assert [body.particle_count for body in model.simulator.scene.bodies] == [450, 451]
    assert torch.equal(model.kept, torch.cat([torch.arange(0, 900, 2), torch.arange(900, 1801, 2)]))
    assert (model.simulator.batch_size, model.simulator.dtype) == (3, simulator.dtype)
    # A particle weighs what it weighed.
    assert model.simulator.scene.particle_volume == task.scene.particle_volume
    state = simulator.initial_state(batch_size=1)
    thin = model.thinned(state)
    assert torch.equal(thin.position, state.position[:, model.kept])
    assert torch.equal(thin.tool_pose, state.tool_pose)
    model.simulator.rollout(thin, torch.zeros(1, 2, 3, dtype=torch.float64))


def test_few_particles_are_not_thinned_out(task):
    bodies = tuple(body.model_copy(update={"particle_count": 400}) for body in task.scene.bodies)
    few = task.scene.model_copy(update={"bodies": bodies})
    assert 400 / (0.001 * 64**3) / PARTICLES_PER_CELL < 1.5
    assert CoarseModel.of(SimulatorToy(few)) is None
    parts = dataclasses.replace(planner(task), objective=ObjectiveTransport(OTSolverToy(), torch.as_tensor(task.load_goal())))
    assert CoarsePlanner.of(parts, beginning(parts), polish=POLISH) is None


def test_a_stage_is_executed_with_all_particles(task):
    parts = planner(task)
    start = beginning(parts)
    result = CoarsePlanner.of(parts, start, polish=POLISH).stage(0, start.state)
    assert result.status is Status.FINISHED
    assert result.state.position.shape == start.state.position.shape
    assert result.priorities.shape == (1801,)
    best = result.candidates[result.best]
    again = parts.simulator.rollout(start.state.with_tools(best.proposal.pose[None]), best.actions[None])
    assert torch.equal(again.final_state.position, result.state.position)
    assert result.loss == best.loss == pytest.approx(float(parts.objective.evaluate(again).loss[0]))
    assert result.loss < 0.9 * result.loss_before
    contacts = [candidate.proposal.contact_particle for candidate in result.candidates]
    assert all(contact in CoarseModel.of(parts.simulator).kept.tolist() for contact in contacts if contact is not None)


class Interrupt(Observer):
    """Control-C after an iteration."""

    def iteration_finished(self, stage, iteration):
        if iteration.index == 2:
            raise KeyboardInterrupt


def test_an_interrupted_stage_keeps_its_best_plan_with_all_particles(task):
    parts = planner(task, observers=(Interrupt(),))
    start = beginning(parts)
    with pytest.raises(StageInterrupted) as caught:
        CoarsePlanner.of(parts, start, polish=POLISH).stage(0, start.state)
    result = caught.value.result
    assert result.status is Status.INTERRUPTED
    assert result.positions.shape[1] == 1801
    assert result.loss < result.loss_before
