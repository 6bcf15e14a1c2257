"""Which candidates of a search are worth more work."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from cpdeform.core.placer import Candidate

MOST_ALIKE = 2
"""Candidates of one label around one contact particle that are taken, at most: the best of a search are often variations of one."""


def best_unlike(candidates: Sequence[Candidate], count: int) -> list[int]:
    """Numbers of the candidates with the lowest finite losses, the best first, at most `MOST_ALIKE` of one family.

    Args:
        candidates: All candidates of a search.
        count: How many, at most.
    """
    losses = _losses(candidates)
    chosen: list[int] = []
    alike: dict[tuple[str, int | None], int] = {}
    for number in losses.argsort(stable=True).tolist():
        if len(chosen) == count or not bool(torch.isfinite(losses[number])):
            break
        proposal = candidates[number].proposal
        family = (proposal.label, proposal.contact_particle)
        alike[family] = alike.get(family, 0) + 1
        if alike[family] <= MOST_ALIKE:
            chosen.append(number)
    return chosen


def best_of_each_kind(candidates: Sequence[Candidate], count: int) -> list[int]:
    """Numbers of candidates with finite losses, the kinds taking turns: the best of each label first, then the second best.

    What a rollout says of a plan tells little of what gradients will make of it. Where the clay is nearly right, those that hardly
    touch it have the lowest losses, and bolder ones more to gain.

    Args:
        candidates: All candidates of a search.
        count: How many, at most.
    """
    losses = _losses(candidates)
    ranked: list[tuple[int, int, int]] = []
    turns: dict[str, int] = {}
    for place, number in enumerate(losses.argsort(stable=True).tolist()):
        if not bool(torch.isfinite(losses[number])):
            break
        kind = candidates[number].proposal.label
        turns[kind] = turns.get(kind, 0) + 1
        ranked.append((turns[kind], place, number))
    return [number for _, _, number in sorted(ranked)[:count]]


def _losses(candidates: Sequence[Candidate]) -> Tensor:
    """Losses (C,) of candidates, infinite where they are not finite."""
    losses = torch.tensor([candidate.loss for candidate in candidates], dtype=torch.float64)
    return torch.where(torch.isfinite(losses), losses, torch.inf)
