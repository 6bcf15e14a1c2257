"""Steps of several worlds, one of which loses the clay."""

from __future__ import annotations

import pytest
import torch

from cpdeform.planning.descent import Descent

EDGE = 0.1
"""Action from which on the toy's tool is off the clay."""


def evaluate(actions):
    """Loss and gradient of worlds of one action each: the first falls up to an edge beyond which nothing matters."""
    first, second = actions.flatten().tolist()
    slope = -1.0 if first <= EDGE else 0.0
    loss = [1.0 - first if first <= EDGE else 2.0, (second - 0.9) ** 2]
    return torch.tensor(loss), torch.tensor([slope, 2.0 * (second - 0.9)]).reshape(2, 1, 1)


def descend(*, backtrack, steps, learning_rate=0.3, leap=None):
    descent, worlds = Descent(torch.zeros(2, 1, 1), backtrack=backtrack, leap=leap), torch.arange(2)
    path = [descent.actions(worlds)]
    for _ in range(steps):
        descent.step(worlds, *evaluate(path[-1]), learning_rate=learning_rate)
        path.append(descent.actions(worlds))
    return torch.stack(path)[..., 0, 0]


def test_a_world_without_a_gain_goes_back_with_half_the_step():
    first, _ = descend(backtrack=1, steps=3).unbind(1)
    torch.testing.assert_close(first, torch.tensor([0.0, 0.3, 0.15, 0.075]))


def test_it_may_wait():
    first, _ = descend(backtrack=3, steps=5).unbind(1)
    assert (first[1:4] > 0.2).all()
    torch.testing.assert_close(first[4], torch.tensor(0.15))
    assert first[5] > 0.15


def test_it_comes_near_the_edge_and_goes_on_from_its_best_plan():
    first, _ = descend(backtrack=1, steps=60).unbind(1)
    assert float(first[first <= EDGE].max()) > 0.0999
    # Each time it lost the clay, the next plan is a smaller step away from the best one that touched.
    for index in (first > EDGE).nonzero().flatten().tolist()[:-1]:
        best = float(first[:index][first[:index] <= EDGE].max())
        assert best < float(first[index + 1]) < float(first[index])


@pytest.mark.parametrize(("leap", "returns"), [(0.9, True), (1.1, False)])
def test_a_leap_of_the_loss_ends_its_patience(leap, returns):
    """The first world's loss doubles in the first step."""
    first, _ = descend(backtrack=4, steps=2, leap=leap).unbind(1)
    assert (float(first[2]) == pytest.approx(0.15)) == returns


def test_without_it_momentum_carries_the_tool_away():
    first, _ = descend(backtrack=None, steps=60).unbind(1)
    assert (first[1:] > EDGE).all()


@pytest.mark.parametrize("backtrack", [1, None])
def test_a_world_that_gains_takes_adams_steps(backtrack):
    """Whatever becomes of the other one."""
    _, second = descend(backtrack=backtrack, steps=20, learning_rate=0.02).unbind(1)
    parameter = torch.zeros(1, requires_grad=True)
    adam = torch.optim.Adam([parameter], lr=0.02)
    for expected in second[1:]:
        adam.zero_grad()
        (parameter - 0.9).square().sum().backward()
        adam.step()
        torch.testing.assert_close(parameter.detach()[0], expected)


def test_actions_are_clipped():
    descent, worlds = Descent(torch.full((1, 2, 3), 0.9), backtrack=4), torch.tensor([0])
    descent.step(worlds, torch.tensor([1.0]), -torch.ones(1, 2, 3), learning_rate=0.3)
    torch.testing.assert_close(descent.actions(worlds), torch.ones(1, 2, 3))


def test_a_world_that_never_touched_stays():
    descent, worlds = Descent(torch.full((1, 2, 3), 0.2), backtrack=1), torch.tensor([0])
    for _ in range(3):
        descent.step(worlds, torch.tensor([1.0]), torch.zeros(1, 2, 3), learning_rate=0.3)
    torch.testing.assert_close(descent.actions(worlds), torch.full((1, 2, 3), 0.2))


def test_a_world_that_breaks_goes_back_at_once():
    descent, worlds = Descent(torch.zeros(1, 1, 1), backtrack=4), torch.tensor([0])
    assert descent.can_return(worlds).tolist() == [False]
    descent.step(worlds, torch.tensor([1.0]), -torch.ones(1, 1, 1), learning_rate=0.3)
    assert descent.can_return(worlds).tolist() == [True]
    for loss, slope, expected in ((float("nan"), 0.0, 0.15), (0.5, float("nan"), 0.075)):
        descent.step(worlds, torch.tensor([loss]), torch.full((1, 1, 1), slope), learning_rate=0.3)
        torch.testing.assert_close(descent.actions(worlds), torch.full((1, 1, 1), expected))


def test_it_goes_on_from_what_was_executed():
    descent, worlds = Descent(torch.zeros(2, 1, 1), backtrack=None), torch.arange(2)
    descent.step(worlds, *evaluate(descent.actions(worlds)), learning_rate=0.3)
    descent.put(worlds, torch.tensor([0.05, -1.5]).reshape(2, 1, 1))
    loss, slope = evaluate(descent.actions(worlds))
    descent.step(worlds, loss, slope, learning_rate=0.01)
    first, second = descent.actions(worlds).flatten().tolist()
    assert 0.05 < first < 0.07
    # Beyond [-1, 1], where it was put there, but no farther.
    assert -1.5 <= second < -1.0
