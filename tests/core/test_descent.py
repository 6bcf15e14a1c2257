"""Steps of several worlds, one of which loses the clay."""

from __future__ import annotations

import pytest
import torch

from cpdeform.core.descent import Descent

EDGE = 0.1
"""Action from which on the toy's tool is off the clay."""


def evaluate(actions):
    """Loss and gradient of worlds of one action each: the first falls up to an edge beyond which nothing matters."""
    first, second = actions.flatten().tolist()
    slope = -1.0 if first <= EDGE else 0.0
    loss = [1.0 - first if first <= EDGE else 2.0, (second - 0.9) ** 2]
    return torch.tensor(loss), torch.tensor([slope, 2.0 * (second - 0.9)]).reshape(2, 1, 1)


def descend(*, backtrack, steps):
    descent, worlds = Descent(torch.zeros(2, 1, 1), backtrack=backtrack), torch.arange(2)
    path = [descent.actions(worlds)]
    for _ in range(steps):
        descent.step(worlds, *evaluate(path[-1]), learning_rate=0.3)
        path.append(descent.actions(worlds))
    return torch.stack(path)[..., 0, 0]


def test_a_world_that_lost_the_clay_goes_back_with_half_the_step():
    first, _ = descend(backtrack=True, steps=3).unbind(1)
    torch.testing.assert_close(first, torch.tensor([0.0, 0.3, 0.15, 0.075]))


def test_it_goes_back_to_its_best_plan_and_on_from_there():
    first, _ = descend(backtrack=True, steps=60).unbind(1)
    touching = first[first <= EDGE]
    assert float(touching.max()) > 0.09
    # Each time it lost the clay, the next plan is a smaller step away from the best one that touched.
    for index in (first > EDGE).nonzero().flatten().tolist()[:-1]:
        best = float(first[:index][first[:index] <= EDGE].max())
        assert best < float(first[index + 1]) < float(first[index])


def test_without_it_momentum_carries_the_tool_away():
    first, _ = descend(backtrack=False, steps=60).unbind(1)
    assert (first[1:] > EDGE).all()


@pytest.mark.parametrize("backtrack", [True, False])
def test_the_other_world_is_adams(backtrack):
    _, second = descend(backtrack=backtrack, steps=20).unbind(1)
    parameter = torch.zeros(1, requires_grad=True)
    adam = torch.optim.Adam([parameter], lr=0.3)
    for expected in second[1:]:
        adam.zero_grad()
        (parameter - 0.9).square().sum().backward()
        adam.step()
        with torch.no_grad():
            parameter.clamp_(-1.0, 1.0)
        torch.testing.assert_close(parameter.detach()[0], expected)


def test_a_world_that_never_touched_stays():
    descent, worlds = Descent(torch.full((1, 2, 3), 0.2), backtrack=True), torch.tensor([0])
    for _ in range(3):
        descent.step(worlds, torch.tensor([1.0]), torch.zeros(1, 2, 3), learning_rate=0.3)
    torch.testing.assert_close(descent.actions(worlds), torch.full((1, 2, 3), 0.2))
