"""A strategy that puts a proposer, a phase and a pruner of one's own together: `cpdeform run writer --strategy example`."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

from cpdeform import Phase, Placer, Strategy, Task
from cpdeform.placement.transport import PlacerTransport
from cpdeform.planning.phases.descent import PhaseDescent
from cpdeform.planning.strategy import Parts
from cpdeform_example.phase import PhaseVariation
from cpdeform_example.proposer import ProposerAbove
from cpdeform_example.pruner import PrunerMargin


class StrategyExample(Strategy):
    """Presses from above or places the tool directly, drops what is far behind, and varies the plan at the end.

    Args:
        speed: First actions of a press from above, in [0, 1].
    """

    def __init__(self, *, speed: float = 0.5) -> None:
        self.speed = speed

    def settings(self, task: Task, *, placer: str | None) -> Mapping[str, Any]:
        """A short search."""
        return {"optimizer": {"iterations": 12}}

    def placer(self, named: Placer, *, task: Task) -> Placer:
        """The paper's placer with one proposer more."""
        return PlacerTransport(proposers=["direct", ProposerAbove(speed=self.speed, steps=task.step_count)])

    def phases(self, parts: Parts) -> tuple[Phase, ...]:
        """A descent that drops what is far behind, then variations."""
        optimizer = dataclasses.replace(parts.optimizer, pruner=PrunerMargin())
        return PhaseDescent(optimizer=optimizer), PhaseVariation()
