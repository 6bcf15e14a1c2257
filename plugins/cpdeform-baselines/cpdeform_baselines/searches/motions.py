"""Motions as a few numbers: actions at evenly spread moments, in between them linear."""

from __future__ import annotations

import torch
from torch import Tensor


def interpolated(knots: Tensor, steps: int) -> Tensor:
    """Actions of a stage from those at some moments.

    Args:
        knots: Actions (..., K, A) at K moments, the first and the last step among them.
        steps: Environment steps T.

    Returns:
        Actions (..., T, A).
    """
    count = knots.shape[-2]
    place = torch.linspace(0.0, count - 1.0, steps)
    left = place.floor().long().clamp(max=max(count - 2, 0))
    weight = (place - left).to(knots).unsqueeze(-1)
    return (1.0 - weight) * knots[..., left, :] + weight * knots[..., (left + 1).clamp(max=count - 1), :]
