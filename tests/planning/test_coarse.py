"""Touches that are screened with fewer particles, on the toy simulator."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from cpdeform_toy.parts import OTSolverToy
from cpdeform_toy.simulator import SimulatorToy

from cpdeform.core.goal import write_goal
from cpdeform.core.placer import Candidate, Proposal, Stage
from cpdeform.core.sampling import sample_particles
from cpdeform.core.task import load_task
from cpdeform.planning.coarse import PARTICLES_PER_CELL, CoarseModel, coarsening
from cpdeform.planning.objectives.shape import ObjectiveShape
from cpdeform.planning.objectives.transport import ObjectiveTransport
from cpdeform.planning.result import Status
from cpdeform.planning.still import still_trajectory
from cpdeform.planning.strategies.sculpt import StrategySculpt
from cpdeform.planning.workbench import Workbench
from cpdeform.run.deform import deform

BODY = {"kind": "box", "position": [0.4, 0.2, 0.5], "widths": [0.1, 0.1, 0.1], "particle_count": 900}
SCENE = {
    "bodies": [BODY, {**BODY, "position": [0.4, 0.4, 0.5], "particle_count": 901}],
    "tools": [{"kind": "Sphere", "radius": 0.05, "position": [0.25, 0.3, 0.5], "action_scale": [0.01, 0.01, 0.01]}],
}


@pytest.fixture
def task(make_toy_task):
    task = load_task(make_toy_task(scene=SCENE, stage_count=2, step_count=5))
    write_goal(task.goal, sample_particles(task.scene) + np.array([0.05, 0.0, 0.0]))
    return task


def objective_of(task):
    goal, start = torch.as_tensor(task.load_goal()), torch.as_tensor(sample_particles(task.scene))
    transport = ObjectiveTransport(OTSolverToy(), goal, scene=task.scene)
    return ObjectiveShape(transport, task.scene, goal, start)


def test_every_second_particle_of_each_body_is_kept(task):
    simulator = SimulatorToy(task.scene, batch_size=3)
    model = CoarseModel.of(simulator, objective_of(task))
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
    assert CoarseModel.of(SimulatorToy(few), objective_of(task)) is None


class Counting(SimulatorToy):
    """Notes the particles of each rollout."""

    def __init__(self, scene, **options):
        super().__init__(scene, **options)
        Counting.seen = getattr(Counting, "seen", [])

    def rollout(self, state, actions):
        Counting.seen.append((state.batch_size, state.particle_count))
        return super().rollout(state, actions)


def test_touches_are_screened_coarsely_and_executed_with_all_particles(task):
    Counting.seen = []
    parts = {"simulator": Counting(task.scene, batch_size=4), "ot_solver": OTSolverToy()}
    strategy = StrategySculpt(touches=6, variations=3, iterations=(1, 1), polished=(2, 1), together=1)
    settings = {"objective": {"points": None}}
    result = deform(task, strategy=strategy, settings=settings, stages=1, **parts, seed=1)
    (stage,) = result.stages
    assert stage.status is Status.FINISHED
    thin = sum(worlds for worlds, particles in Counting.seen if particles == 901)
    # Six touches and two rounds of three, all with half of the particles; with all are the execution and the clay left alone.
    assert (thin, stage.rollouts) == (len(stage.candidates), len(stage.candidates) + 2)
    assert stage.positions.shape[1] == 1801
    # Only plans that were polished with all particles are in the race.
    assert sum(np.isfinite(candidate.loss) for candidate in stage.candidates) <= 2
    Counting.seen = []
    deform(task, strategy=StrategySculpt(touches=6, coarse=False, together=1), settings=settings, stages=1, **parts, seed=1)
    assert all(particles == 1801 for _, particles in Counting.seen)


def test_coarse_losses_start_from_the_loss_of_the_state(task):
    """A touch that moves nothing has the state's own loss; one that moves all alike changes the loss as with all particles."""
    simulator, objective = SimulatorToy(task.scene, batch_size=4), objective_of(task)
    state = simulator.initial_state(batch_size=1)
    loss = float(objective.evaluate(still_trajectory(state, 5, scene=task.scene)).loss[0])
    stage = Stage(0, task.scene, state, objective.goal, None, torch.Generator(), loss=loss, step_count=5)
    bench = Workbench(stage=stage, task=task, simulator=simulator, objective=objective)
    plans = [torch.zeros(5, 3), torch.tensor([0.5, 0.0, 0.0]).repeat(5, 1)]
    candidates = [Candidate(Proposal(state.tool_pose[0], 0.0, "way", None), float("nan"), plan) for plan in plans]
    found = CoarseModel.of(simulator, objective).rollout_losses(bench, candidates, phase="screening")
    assert bench.rollouts == 2
    assert float(found[0]) == pytest.approx(loss, rel=1e-9)
    whole = bench.rollout_losses(candidates, None, phase="screening")
    assert float(found[1] - found[0]) == pytest.approx(float(whole[1] - whole[0]), rel=0.2)
    assert float(found[1]) < float(found[0])
