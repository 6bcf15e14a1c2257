"""Soft IoU by hand and by its invariants."""

from __future__ import annotations

import math

import pytest
import torch

from cpdeform.core.errors import InputError
from cpdeform.planning.objectives.metrics import incremental_iou, soft_iou


def grid(*masses: float) -> torch.Tensor:
    result = torch.zeros(4, 4, 4, dtype=torch.float64)
    result.view(-1)[: len(masses)] = torch.tensor(masses, dtype=torch.float64)
    return result


def test_by_hand() -> None:
    assert float(soft_iou(grid(2.0, 1.0), grid(0.0, 3.0))) == pytest.approx(0.5 / (1.5 + 1.0 - 0.5))


def test_against_itself() -> None:
    assert float(soft_iou(grid(3.0, 3.0), grid(3.0, 3.0))) == 1.0
    assert float(soft_iou(grid(2.0, 1.0), grid(2.0, 1.0))) == pytest.approx(1.25 / (3.0 - 1.25))


def test_scale_of_the_masses_does_not_count() -> None:
    first, second = torch.rand(3, 4, 4, 4, dtype=torch.float64), torch.rand(4, 4, 4, dtype=torch.float64)
    assert soft_iou(first, second).shape == (3,)
    assert torch.allclose(soft_iou(first, second), soft_iou(7.0 * first, 0.1 * second))
    assert torch.allclose(soft_iou(first, second), soft_iou(second, first))


def test_increment_is_zero_at_the_start_and_one_at_the_goal() -> None:
    start, goal = grid(1.0, 1.0, 0.5), grid(0.0, 1.0, 0.7, 0.9)
    assert float(incremental_iou(start, start, goal)) == 0.0
    assert float(incremental_iou(goal, start, goal)) == 1.0
    assert float(incremental_iou(grid(1.0), start, goal)) == 0.0
    between = incremental_iou(0.5 * (start + goal), start, goal)
    assert 0.0 < float(between) < 1.0
    assert math.isnan(float(incremental_iou(goal, goal, goal)))


def test_unusable_grids_are_named() -> None:
    with pytest.raises(InputError, match="first: got a grid without mass"):
        soft_iou(grid(), grid(1.0))
    with pytest.raises(InputError, match="second: got shape"):
        soft_iou(grid(1.0), torch.ones(5, 5, 5))
