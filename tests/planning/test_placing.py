"""Tools placed anew by the gradients that lead the actions, on a toy that carries the body the better the nearer its tool is."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from cpdeform_toy.parts import OTSolverToy, PlacerToy
from cpdeform_toy.simulator import SimulatorToy

from cpdeform.core.simulator import RolloutGradient
from cpdeform.core.task import load_task
from cpdeform.planning.algorithm import Planner
from cpdeform.planning.interrupted import StageInterrupted
from cpdeform.planning.joint import polish_jointly
from cpdeform.planning.objectives.transport import ObjectiveTransport
from cpdeform.planning.optimizer import TrajectoryOptimizer
from cpdeform.planning.phases.descent import PhaseDescent
from cpdeform.planning.phases.polish import PhasePolish
from cpdeform.planning.pruner import PrunerNone
from cpdeform.planning.result import Observer


class SimulatorNear(SimulatorToy):
    """The toy with gradients by the first tool's place and by the body's, and those that can be chained."""

    def vjp(self, trajectory, grad_positions, grad_tools=None, *, grad_final_state=None) -> RolloutGradient:
        if grad_final_state is not None:
            grad_positions = grad_positions.clone()
            grad_positions[:, -1] += grad_final_state.position
        found = super().vjp(trajectory, grad_positions, grad_tools)
        start = trajectory.initial_state
        distance = start.tool_pose[:, 0, 0] - start.position[:, :, 0].mean(dim=1)
        shift = self._pad(torch.cumsum(trajectory.actions[..., :3] * self.scale(trajectory.actions), dim=1))
        by_gain = (grad_positions.sum(dim=2) * shift).sum(dim=(1, 2))
        slope = by_gain * self.gain(start) * -8.0 * distance
        pose = torch.zeros_like(start.tool_pose)
        pose[:, 0, 0] = slope
        position = grad_positions.sum(dim=1)
        position[..., 0] -= slope[:, None] / position.shape[1]
        return RolloutGradient(found.actions, dataclasses.replace(found.initial_state, position=position, tool_pose=pose))


@pytest.fixture
def task(make_toy_task):
    return load_task(make_toy_task(stage_count=3, step_count=5))


def planner(task, *phases, **options):
    optimizer = TrajectoryOptimizer(iterations=2, pruner=PrunerNone())
    return Planner(
        task=task,
        simulator=SimulatorNear(task.scene, batch_size=4),
        ot_solver=OTSolverToy(),
        placer=PlacerToy(),
        objective=ObjectiveTransport(OTSolverToy(), torch.as_tensor(task.load_goal()), scene=task.scene),
        phases=(PhaseDescent(optimizer=optimizer), *phases),
        **options,
    )


def polish(*, placing=True, iterations=6):
    optimizer = TrajectoryOptimizer(iterations=iterations, learning_rate=0.2, pruner=PrunerNone())
    return PhasePolish(keep=2, optimizer=optimizer, placing=placing)


def distance(result):
    """How far the tool begins from the body, along x."""
    return abs(float(result.tool_poses[0, 0, 0] - result.state_before.position[0, :, 0].mean()))


def test_a_polish_that_places_tools_gains_more(task):
    fixed, placed = (planner(task, polish(placing=placing)).run(stages=1).stages[0] for placing in (False, True))
    assert placed.loss < fixed.loss
    assert not torch.equal(placed.tool_poses[0], fixed.tool_poses[0])
    candidate = placed.candidates[placed.best]
    assert torch.equal(candidate.proposal.pose, placed.tool_poses[0])
    assert candidate.actions.shape == fixed.actions.shape == placed.actions.shape
    # What is recorded is what is executed.
    start = placed.state_before.with_tools(candidate.proposal.pose[None])
    replayed = SimulatorNear(task.scene).rollout(start, candidate.actions[None])
    assert torch.equal(replayed.final_state.position, placed.state.position)
    assert candidate.loss == pytest.approx(placed.loss)


class Interrupt(Observer):
    def __init__(self, iterations):
        self.left = iterations

    def iteration_finished(self, stage, iteration):
        self.left -= iteration.phase == "polish"
        if not self.left:
            raise KeyboardInterrupt


def test_an_interrupted_polish_keeps_the_places_so_far(task):
    parts = planner(task, polish(), observers=(Interrupt(4),))
    with pytest.raises(StageInterrupted) as caught:
        parts.run(stages=1)
    shorter = planner(task, polish(iterations=4)).run(stages=1).stages[0]
    found = caught.value.result
    assert torch.equal(found.tool_poses, shorter.tool_poses)
    assert torch.equal(found.actions, shorter.actions)
    assert found.loss == shorter.loss


def test_stages_polished_together_place_their_tools_anew(task):
    parts = planner(task)
    before = parts.run(stages=2).stages
    after = polish_jointly(parts, before, TrajectoryOptimizer(iterations=20, learning_rate=0.2, pruner=PrunerNone()))
    assert after[-1].loss < before[-1].loss
    for old, new in zip(before, after, strict=True):
        assert distance(new) != distance(old)
        assert new.actions.shape == old.actions.shape
        assert torch.equal(new.candidates[new.best].proposal.pose, new.tool_poses[0])
    # The nearer the tool the farther it carries the body; the last one gains most by that.
    assert distance(after[-1]) < distance(before[-1])
