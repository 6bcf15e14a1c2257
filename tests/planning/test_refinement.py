"""Refinement of a stage's plan, on the toy simulator: what is kept, what is counted."""

from __future__ import annotations

import re

import pytest
import torch
from cpdeform_toy.parts import OTSolverToy, PlacerToy
from cpdeform_toy.simulator import SimulatorToy

from cpdeform.cli import progress
from cpdeform.core.objective import ObjectiveAutograd
from cpdeform.core.plugins import load_registry
from cpdeform.core.task import load_task
from cpdeform.planning.algorithm import Planner
from cpdeform.planning.objectives.density import ObjectiveDensity
from cpdeform.planning.objectives.soft_iou import ObjectiveSoftIoU
from cpdeform.planning.objectives.transport import ObjectiveTransport
from cpdeform.planning.optimizer import TrajectoryOptimizer
from cpdeform.planning.phases.descent import REFINEMENT, PhaseDescent, PhaseRefinement
from cpdeform.run.configuration import RefinementConfiguration
from cpdeform.run.deform import deform
from cpdeform.run.parts import make_refinement

ITERATIONS = 8


class Offset(ObjectiveAutograd):
    """Squared distance of the final centre of mass from a point."""

    def __init__(self, point):
        self.point = point

    def loss(self, positions, tool_poses):
        return (positions[:, -1].mean(dim=1) - self.point.to(positions)).square().sum(dim=-1)


@pytest.fixture
def task(toy_task_file):
    return load_task(toy_task_file)


def run(task, point=None, **options):
    optimizer = TrajectoryOptimizer(iterations=ITERATIONS, learning_rate=0.02)
    search = PhaseDescent(optimizer=TrajectoryOptimizer(iterations=2))
    refinement = () if point is None else (PhaseRefinement(objective=Offset(point), optimizer=optimizer),)
    planner = Planner(
        task=task,
        simulator=SimulatorToy(task.scene, batch_size=4),
        ot_solver=OTSolverToy(),
        placer=PlacerToy(),
        objective=ObjectiveTransport(OTSolverToy(), torch.as_tensor(task.load_goal()), scene=task.scene),
        phases=(search, *refinement),
        **options,
    )
    return planner.run(stages=1).stages[0]


def goal(task):
    return torch.as_tensor(task.load_goal()).mean(dim=0)


def test_a_better_plan_is_executed_and_counted(task):
    plain, refined = run(task), run(task, goal(task))
    assert refined.loss < plain.loss
    assert refined.loss == pytest.approx(float(Offset(goal(task)).loss(refined.positions[None], None)[0]), rel=1e-5)
    assert refined.best == plain.best
    assert torch.equal(refined.actions, refined.candidates[refined.best].actions)
    assert refined.candidates[refined.best].loss == refined.loss
    assert refined.gradient_evaluations == plain.gradient_evaluations + ITERATIONS
    assert [iteration.phase for iteration in refined.history] == ["search"] * 2 + [REFINEMENT] * ITERATIONS
    assert "refinement" in refined.seconds
    assert "refinement" not in plain.seconds


def test_a_plan_that_cannot_gain_stays(task):
    """Its end is the refinement's goal already."""
    plain = run(task)
    refined = run(task, plain.positions[-1].mean(dim=0))
    assert torch.equal(refined.actions, plain.actions)
    assert refined.loss == plain.loss


def test_a_plan_worse_than_leaving_the_shape_alone_is_dropped(task):
    start = torch.as_tensor(task.load_goal()).mean(dim=0)
    plain = run(task)
    away = plain.state_before.position[0].mean(dim=0) * 2.0 - start.to(plain.state_before.position)
    refined = run(task, away)
    assert torch.equal(refined.actions, plain.actions)
    assert refined.loss == plain.loss < plain.loss_before


def test_the_configuration_makes_it(task):
    simulator, registry = SimulatorToy(task.scene, batch_size=1), load_registry()

    def make(most=40, **options):
        options = RefinementConfiguration(**options)
        return make_refinement(task, OTSolverToy(), simulator, options=options, blur=2e-3, most=most, registry=registry)

    assert make() is None
    made = make(iterations=9, learning_rate=0.5, patience=3)
    objective, optimizer = made
    assert (optimizer.iterations, optimizer.learning_rate, optimizer.patience) == (9, 0.5, 3)
    assert make(most=4, iterations=9)[1].iterations == 4
    assert isinstance(objective, ObjectiveDensity)
    assert isinstance(make(iterations=9, kind="iou")[0], ObjectiveSoftIoU)


def test_refinement_by_transport_has_nothing_that_a_task_adds_for_the_search(task):
    """Its loss is that of the plain cost, and the plan that it leaves has a lower one."""
    weights = {"axis_scale": [1.0, 4.0, 1.0], "coast_steps": 0.1}
    settings = {"objective": weights, "refinement": {"kind": "transport", "iterations": ITERATIONS}}
    parts = {"simulator": SimulatorToy(task.scene, batch_size=4), "ot_solver": OTSolverToy(), "placer": PlacerToy()}
    optimizer = TrajectoryOptimizer(iterations=ITERATIONS, learning_rate=0.02)
    (stage,) = deform(task, **parts, settings=settings, optimizer=optimizer, stages=1).stages
    refined = [float(iteration.loss[0]) for iteration in stage.history if iteration.phase == REFINEMENT]
    plain = ObjectiveTransport(OTSolverToy(), torch.as_tensor(task.load_goal()), scene=task.scene)
    start = SimulatorToy(task.scene, batch_size=1)
    found = stage.candidates[stage.best]
    world = stage.state_before.with_tools(found.proposal.pose.unsqueeze(0))
    final = float(plain.evaluate(start.rollout(world, stage.actions.unsqueeze(0))).loss[0])
    assert final == pytest.approx(min(refined), rel=1e-5)
    assert final < refined[0]


def test_a_loss_given_as_an_object_is_not_followed_by_another(task):
    parts = {"simulator": SimulatorToy(task.scene, batch_size=4), "ot_solver": OTSolverToy(), "placer": PlacerToy()}
    options = {**parts, "optimizer": TrajectoryOptimizer(iterations=2), "stages": 1}
    options["settings"] = {"refinement": {"iterations": 9}}
    (refined,) = deform(task, **options).stages
    assert [iteration.phase for iteration in refined.history] == ["search"] * 2 + [REFINEMENT] * 2
    (plain,) = deform(task, objective=Offset(goal(task)), **options).stages
    assert [iteration.phase for iteration in plain.history] == ["search"] * 2


def test_progress_tells_the_phase_and_the_bar_stays(task, monkeypatch, capsys):
    monkeypatch.setattr(progress, "SECONDS_BETWEEN_LINES", 0.0)
    bar = progress.ProgressBar(stages=1)
    run(task, goal(task), observers=(progress.ProgressLines(), bar))
    err = capsys.readouterr().err
    assert re.search(rf"stage 1,( batch \d+,)? refinement {ITERATIONS}/{ITERATIONS}, loss", err)
    (shown,) = bar._progress.tasks
    assert (shown.completed, shown.total) == (2, 2)
    assert shown.description.startswith("stage 1 refinement")
