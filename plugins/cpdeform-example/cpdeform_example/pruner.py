"""A pruner: candidates far behind the best one go."""

from __future__ import annotations

import dataclasses
from typing import ClassVar

from torch import Tensor

from cpdeform import Pruner


@dataclasses.dataclass(frozen=True, kw_only=True)
class PrunerMargin(Pruner):
    """Drops candidates whose best loss is larger than the lowest one by more than a margin.

    Attributes:
        margin: Relative margin.
        least_iterations: Iterations before which none is dropped.
    """

    name: ClassVar[str] = "margin"
    margin: float = 0.1
    least_iterations: int = 2

    def survivors(self, active: Tensor, best_loss: Tensor, *, done: int, iterations: int) -> Tensor:
        """Those within the margin."""
        if done < self.least_iterations:
            return active
        return active[best_loss[active] <= (1.0 + self.margin) * best_loss.min()]
