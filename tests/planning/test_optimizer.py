from __future__ import annotations

import math

import pytest
import torch
from cpdeform_toy.simulator import SimulatorToy

from cpdeform.core.errors import InputError
from cpdeform.core.objective import ObjectiveAutograd
from cpdeform.core.task import load_task
from cpdeform.planning.optimizer import TrajectoryOptimizer
from cpdeform.planning.pruner import PrunerNone


class Distance(ObjectiveAutograd):
    """Squared distance of the final centre from a point."""

    def __init__(self, goal):
        self.goal = torch.as_tensor(goal, dtype=torch.float64)

    def loss(self, positions, tool_poses):
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
    optimizer = TrajectoryOptimizer(iterations=200, learning_rate=0.02, patience=200, pruner=PrunerNone())
    seen = []
    objective = Distance(goal(state, [0.03, -0.02, 0.01]))
    result = optimizer.minimize(simulator, state, zeros(), objective, on_iteration=seen.append)
    assert (result.loss < 1e-8).all()
    torch.testing.assert_close(result.actions[0].sum(dim=0) * 0.02, torch.tensor([0.03, -0.02, 0.01]).double(), atol=1e-4, rtol=0)
    assert result.gradient_evaluations == 3 * len(result.history) == 3 * len(seen)
    assert result.finite.all()
    assert set(seen[0].seconds) == {"rollout", "objective", "vjp", "optimizer"}
    losses, best = (torch.stack([getattr(item, name) for item in result.history]) for name in ("loss", "best_loss"))
    # The loss goes up and down on its way, and its lowest value so far is kept.
    assert (losses.diff(dim=0) > 0).any()
    assert torch.equal(best, losses.cummin(dim=0).values)


def test_rest_stays_as_it_is_and_counts(simulator, state):
    first = zeros()
    first[:, 3:] = 0.25
    optimizer = TrajectoryOptimizer(iterations=120, learning_rate=0.02, patience=120, pruner=PrunerNone())
    result = optimizer.minimize(simulator, state, first, Distance(goal(state, [0.02, 0.02, 0.02])), rest_steps=2)
    assert torch.equal(result.actions[:, 3:], first[:, 3:].double())
    # the plan of the first three steps makes up for what the last two do
    torch.testing.assert_close(result.actions.sum(dim=1) * 0.02, torch.full((3, 3), 0.02).double(), atol=1e-4, rtol=0)


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
    optimizer = TrajectoryOptimizer(iterations=8, pruner=PrunerNone())
    result = optimizer.minimize(simulator, state, actions, Distance(goal(state, [0.4, 0.0, 0.0])))
    assert result.finite.tolist() == [False, True]
    assert torch.isfinite(result.loss).all()
    assert 0.3 < float(result.actions[0, :, 0].max()) <= 0.55
    assert len(result.history) == 8
    losses = torch.stack([iteration.loss for iteration in result.history])
    assert losses[-1, 1] < losses[0, 1]
    assert losses[:, 0].isnan().any()


def test_a_world_that_breaks_goes_on_from_its_best_plan(toy_task_file):
    """Steps of 0.2 break at the third one; halved again and again they come close to where the world breaks."""
    simulator = SimulatorToy(load_task(toy_task_file).scene, batch_size=1, break_above=0.55)
    state = simulator.initial_state()

    def reached(backtrack):
        optimizer = TrajectoryOptimizer(iterations=30, learning_rate=0.2, backtrack=backtrack)
        return optimizer.minimize(simulator, state, zeros(1), Distance(goal(state, [0.4, 0.0, 0.0])))

    stopped, back = reached(None), reached(4)
    assert torch.stack([iteration.loss for iteration in stopped.history]).isnan().sum() == 1
    assert torch.stack([iteration.loss for iteration in back.history]).isnan().sum() > 1
    assert float(stopped.actions[0, :, 0].max()) < 0.45
    assert 0.54 < float(back.actions[0, :, 0].max()) <= 0.55
    assert float(back.loss) < float(stopped.loss)
    assert not bool(back.finite)


class Watching(Distance):
    """Remembers the final positions that it was asked about."""

    def __init__(self, goal):
        super().__init__(goal)
        self.asked = []

    def loss(self, positions, tool_poses):
        self.asked.append(positions[:, -1].detach().clone())
        return super().loss(positions, tool_poses)


def test_the_objective_is_asked_about_the_best_end_where_a_world_breaks(toy_task_file):
    """What it keeps for warm starts then fits the plan that the world goes back to."""
    simulator = SimulatorToy(load_task(toy_task_file).scene, batch_size=1, break_above=0.55)
    state = simulator.initial_state()
    objective = Watching(goal(state, [0.4, 0.0, 0.0]))
    result = TrajectoryOptimizer(iterations=8, learning_rate=0.2).minimize(simulator, state, zeros(1), objective)
    losses = torch.cat([iteration.loss for iteration in result.history])
    assert losses.isnan().any()
    for index in losses.isnan().nonzero().flatten().tolist():
        before = int(losses[:index].nan_to_num(torch.inf).argmin())
        assert torch.equal(objective.asked[index], objective.asked[before])


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


class Remembering(Distance):
    """Records the size of each batch."""

    def __init__(self, goal):
        super().__init__(goal)
        self.sizes = []

    def loss(self, positions, tool_poses):
        self.sizes.append(len(positions))
        return super().loss(positions, tool_poses)


def test_halving_drops_the_worse_half_and_the_winner_is_that_of_the_paper(simulator, state):
    # the second world starts nearest to the goal, the third farthest from it
    first = torch.tensor([0.3, 0.8, -0.9])[:, None, None].expand(3, 5, 3).clone()
    shift = [0.08, 0.08, 0.08]
    objective = Remembering(goal(state, shift))
    options = {"iterations": 24, "learning_rate": 0.01, "patience": 24}
    halved = TrajectoryOptimizer(**options).minimize(simulator, state, first, objective)
    full = TrajectoryOptimizer(**options, pruner=PrunerNone()).minimize(simulator, state, first, Distance(goal(state, shift)))
    # of 3 worlds 2 are left after 1/4 and 1 after 1/2 of the iterations
    assert objective.sizes == [3] * 6 + [2] * 6 + [1] * 12
    assert halved.gradient_evaluations == sum(objective.sizes)
    assert full.gradient_evaluations == 72
    assert int(halved.loss.argmin()) == int(full.loss.argmin()) == 1
    torch.testing.assert_close(halved.actions[1], full.actions[1], rtol=0, atol=0)
    assert halved.finite.all()
    last = halved.history[-1]
    assert last.loss.isnan().tolist() == [True, False, True]
    # the worlds that were dropped come back with the best they had
    for world, iterations in ((0, 12), (2, 6)):
        seen = torch.stack([iteration.loss[world] for iteration in full.history[:iterations]])
        assert float(halved.loss[world]) == float(seen.min())


def test_a_single_world_is_not_dropped(simulator, state):
    one = state.select(0)
    options = {"iterations": 8, "patience": 8}
    objective = Distance(goal(state, [0.05, 0.0, 0.0]))
    halved = TrajectoryOptimizer(**options).minimize(simulator, one, zeros(1), objective)
    full = TrajectoryOptimizer(**options, pruner=PrunerNone()).minimize(simulator, one, zeros(1), objective)
    assert torch.equal(halved.actions, full.actions)
    assert halved.gradient_evaluations == full.gradient_evaluations == 8


def test_first_actions():
    optimizer = TrajectoryOptimizer(initial_noise=5.0)
    first = optimizer.initial_actions((2, 5, 3), torch.Generator().manual_seed(1))
    assert float(first.abs().max()) == 1.0
    assert torch.equal(first, optimizer.initial_actions((2, 5, 3), torch.Generator().manual_seed(1)))
    assert not TrajectoryOptimizer(initial_noise=0.0).initial_actions((2, 5, 3), torch.Generator()).any()


@pytest.mark.parametrize(
    "options",
    [
        {"iterations": 0},
        {"learning_rate": 0.0},
        {"backtrack": 0},
        {"leap": -0.1},
        {"warm_up": 0},
        {"patience": 0},
        {"tolerance": -1.0},
        {"initial_noise": float("nan")},
    ],
)
def test_refuses(options):
    with pytest.raises(InputError, match=f"optimizer.{next(iter(options))}"):
        TrajectoryOptimizer(**options)


class Along(ObjectiveAutograd):
    """How far the centre is from a wall along x: a constant slope."""

    def loss(self, positions, tool_poses):
        return 1.0 - positions[:, -1, :, 0].mean(dim=1)


def test_the_step_size_rises_stays_and_falls(simulator, state):
    """Where the slope is constant each of Adam's steps is as large as the step size: a loss falls by it in each of five actions."""
    optimizer = TrajectoryOptimizer(iterations=9, learning_rate=0.04, warm_up=2, annealed=True, pruner=PrunerNone())
    losses = [iteration.loss[0] for iteration in optimizer.minimize(simulator, state, zeros(), Along()).history]
    steps = -torch.stack(losses).diff() / (5 * 0.02)
    falling = [0.04 * (0.5 + 0.5 * math.cos(math.pi * share)) for share in (1 / 9, 3 / 9, 5 / 9)]
    torch.testing.assert_close(steps, torch.tensor([0.02, 0.04, 0.04, 0.04, 0.04, *falling]).double(), rtol=1e-3, atol=0.0)
