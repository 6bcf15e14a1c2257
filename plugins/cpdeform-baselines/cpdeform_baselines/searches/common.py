"""What the searches share: options, random numbers, phases."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from cpdeform.core.options import real_number, whole_number
from cpdeform.core.placer import Stage
from cpdeform.planning.phases.phase import Phase
from cpdeform.planning.phases.screening import PhaseScreening

MOST = 1_000_000
"""The most of anything that is counted."""

EVALUATIONS = 15
"""Contact plans that are evaluated in a stage, as in the paper's comparison."""


def count(name: str, value: Any, *, least: int = 1) -> int:
    """A number of things."""
    return whole_number(name, value, least=least, most=MOST)


def spread(name: str, value: Any) -> float:
    """A standard deviation, in units of action."""
    return real_number(name, value, least=1e-6, most=10.0)


def stage_seed(stage: Stage) -> int:
    """A seed that follows from those of the run and the stage."""
    return int(torch.randint(2**31, (1,), generator=stage.generator))


def stage_numbers(stage: Stage) -> np.random.Generator:
    """Random numbers that follow from the seeds of the run and the stage."""
    return np.random.default_rng(stage_seed(stage))


def rollouts_only() -> tuple[Phase, ...]:
    """The phases of a search without gradients: every candidate is judged by one rollout of its own actions."""
    return (PhaseScreening(keep=MOST),)
