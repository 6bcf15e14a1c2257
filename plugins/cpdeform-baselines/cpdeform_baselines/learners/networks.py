"""Networks of the first-order learner: a stochastic policy, a value function, and the normalisation of what they see."""

from __future__ import annotations

import torch
from torch import Tensor, nn

CLIP = 10.0
"""Normalised observations go no farther from 0."""


class Normalisation(nn.Module):
    """Running mean and standard deviation of observations.

    Args:
        size: Numbers O of an observation.
    """

    mean: Tensor
    square: Tensor
    count: Tensor

    def __init__(self, size: int) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(size))
        self.register_buffer("square", torch.ones(size))
        self.register_buffer("count", torch.tensor(1e-4))

    def update(self, observations: Tensor) -> None:
        """Take observations (K, O) into account (parallel algorithm of Chan, Golub, LeVeque)."""
        with torch.no_grad():
            mean, variance, count = observations.mean(dim=0), observations.var(dim=0, unbiased=False), len(observations)
            total, difference = self.count + count, mean - self.mean
            spread = self.square * self.count + variance * count + difference.square() * self.count * count / total
            self.mean.add_(difference * count / total)
            self.square.copy_(spread / total)
            self.count.copy_(total)

    def forward(self, observations: Tensor) -> Tensor:
        """Observations (..., O) with mean 0 and standard deviation 1, about; differentiable."""
        scaled: Tensor = (observations - self.mean) / (self.square + 1e-6).sqrt()
        return scaled.clamp(-CLIP, CLIP)


def layers(inputs: int, outputs: int, hidden: tuple[int, ...]) -> nn.Sequential:
    """A network of ELU layers with layer normalisation."""
    parts: list[nn.Module] = []
    for width in hidden:
        parts += [nn.Linear(inputs, width), nn.ELU(), nn.LayerNorm(width)]
        inputs = width
    return nn.Sequential(*parts, nn.Linear(inputs, outputs))


class Actor(nn.Module):
    """Actions tanh(mean(o) + deviation * noise).

    Args:
        observations: Numbers of an observation.
        actions: Numbers of an action.
        hidden: Widths of the layers.
        log_deviation: First logarithm of the noise's standard deviation, the same for every observation, learnt.
    """

    def __init__(self, observations: int, actions: int, hidden: tuple[int, ...] = (128, 64), log_deviation: float = -1.0) -> None:
        super().__init__()
        self.mean = layers(observations, actions, hidden)
        self.log_deviation = nn.Parameter(torch.full((actions,), log_deviation))

    def forward(self, observations: Tensor, noise: Tensor | None = None) -> Tensor:
        """Actions (..., A) in (-1, 1); without noise, those of the mean."""
        mean: Tensor = self.mean(observations)
        return torch.tanh(mean if noise is None else mean + self.log_deviation.exp() * noise)
