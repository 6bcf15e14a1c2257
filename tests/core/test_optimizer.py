from __future__ import annotations

import pytest
import torch
from cpdeform_toy.simulator import SimulatorToy

from cpdeform.core.errors import InputError
from cpdeform.core.objective import ObjectiveAutograd
from cpdeform.core.optimizer import TrajectoryOptimizer
from cpdeform.core.task import load_task


class Distance(ObjectiveAutograd):
    """Squared distance of the final centre from a point."""

    def __init__(self, goal):
        self.goal = torch.as_tensor(goal, dtype=torch.float64)

    def loss(self, positions, manipulator_poses):
        return ((positions[:, -1].mean(dim=1) - self.goal) ** 2).sum(dim=-1)


@pytest.fixture
def simulator(toy_task_file):
    return SimulatorToy(load_task(toy_task_file).scene, batch_size=3)


@pytest.fixture
def state(simulator):
    return simulator.initial_state()


def zeros(worlds=3):
    return torch.zeros(worlds, 5, 3)


def goal(state, shift):
    return state.position[0].mean(dim=0) + torch.tensor(shift, dtype=torch.float64)


def test_reaches_the_optimum(simulator, state):
    optimizer = TrajectoryOptimizer(iterations=200, learning_rate=0.02, patience=200)
    seen = []
    objective = Distance(goal(state, [0.03, -0.02, 0.01]))
    result = optimizer.minimize(simulator, state, zeros(), objective, on_iteration=seen.append)
    assert (result.loss < 1e-8).all()
    torch.testing.assert_close(result.actions[0].sum(dim=0) * 0.02, torch.tensor([0.03, -0.02, 0.01]).double(), atol=1e-4, rtol=0)
    assert result.gradient_evaluations == 3 * len(result.history) == 3 * len(seen)
    assert result.finite.all()
    assert set(seen[0].seconds) == {"rollout", "objective", "vjp", "optimizer"}
    best = torch.stack([iteration.best_loss for iteration in result.history])
    assert (best.diff(dim=0) <= 0).all()


def test_actions_are_clipped(simulator, state):
    result = TrajectoryOptimizer(iterations=60).minimize(simulator, state, zeros(), Distance(goal(state, [0.4, 0.0, 0.0])))
    assert float(result.actions.max()) == 1.0
    assert float(result.actions.abs().max()) <= 1.0


def test_the_best_plan_is_kept_not_the_last(simulator, state):
    """A step far too large: the first evaluation is the best one, and its actions are what comes back."""
    first = zeros() + 0.2
    objective = Distance(goal(state, [0.02001, 0.02, 0.02]))
    result = TrajectoryOptimizer(iterations=5, learning_rate=0.9).minimize(simulator, state, first, objective)
    assert result.history[-1].loss[0] > result.loss[0]
    torch.testing.assert_close(result.actions, first.double())
    repeated = objective.evaluate(simulator.rollout(state, result.actions)).loss
    torch.testing.assert_close(repeated, result.loss)


def test_a_world_that_breaks_keeps_its_best_and_the_others_go_on(toy_task_file):
    simulator = SimulatorToy(load_task(toy_task_file).scene, batch_size=2, break_above=0.55)
    state = simulator.initial_state()
    actions = zeros(2)
    actions[1] = -1.0
    result = TrajectoryOptimizer(iterations=8).minimize(simulator, state, actions, Distance(goal(state, [0.4, 0.0, 0.0])))
    assert result.finite.tolist() == [False, True]
    assert torch.isfinite(result.loss).all()
    assert 0.3 < float(result.actions[0, :, 0].max()) <= 0.55
    assert len(result.history) == 8
    losses = torch.stack([iteration.loss for iteration in result.history])
    assert losses[-1, 1] < losses[0, 1]
    assert losses[:, 0].isnan().any()


def test_all_worlds_broken_from_the_start(toy_task_file):
    simulator = SimulatorToy(load_task(toy_task_file).scene, batch_size=2, break_above=-1.0)
    state = simulator.initial_state()
    result = TrajectoryOptimizer().minimize(simulator, state, zeros(2), Distance(goal(state, [0.1, 0.0, 0.0])))
    assert result.loss.isinf().all()
    assert not result.finite.any()
    assert len(result.history) == 1


def test_stops_early(simulator, state):
    objective = Distance(goal(state, [0.0, 0.0, 0.0]))
    result = TrajectoryOptimizer(iterations=100, patience=4).minimize(simulator, state, zeros(), objective)
    assert len(result.history) == 5


def test_worlds_do_not_influence_each_other(simulator, state):
    actions = torch.randn(3, 5, 3, generator=torch.Generator().manual_seed(0)).double().clamp(-1, 1)
    optimizer, objective = TrajectoryOptimizer(iterations=10), Distance(goal(state, [0.05, 0.0, 0.02]))
    together = optimizer.minimize(simulator, state, actions, objective)
    alone = optimizer.minimize(simulator, state.select(1), actions[1:2], objective)
    torch.testing.assert_close(together.actions[1:2], alone.actions)


def test_first_actions():
    optimizer = TrajectoryOptimizer(initial_noise=5.0)
    first = optimizer.initial_actions((2, 5, 3), torch.Generator().manual_seed(1))
    assert float(first.abs().max()) == 1.0
    assert torch.equal(first, optimizer.initial_actions((2, 5, 3), torch.Generator().manual_seed(1)))
    assert not TrajectoryOptimizer(initial_noise=0.0).initial_actions((2, 5, 3), torch.Generator()).any()


@pytest.mark.parametrize(
    "options", [{"iterations": 0}, {"learning_rate": 0.0}, {"patience": 0}, {"tolerance": -1.0}, {"initial_noise": float("nan")}]
)
def test_refuses(options):
    with pytest.raises(InputError, match=f"optimizer.{next(iter(options))}"):
        TrajectoryOptimizer(**options)
