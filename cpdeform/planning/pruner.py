"""Pruners: which candidates of a round go on, judged by their losses so far."""

from __future__ import annotations

import abc
import dataclasses
import math
from typing import ClassVar

from torch import Tensor

from cpdeform.core.errors import UnknownNameError

LEAST_ITERATIONS = 5
"""No candidate is dropped before: the first losses are those of tools that have hardly moved."""


class Pruner(abc.ABC):
    """Decides after each iteration of a descent which candidates go on. It keeps nothing between calls."""

    name: ClassVar[str]

    @abc.abstractmethod
    def survivors(self, active: Tensor, best_loss: Tensor, *, done: int, iterations: int) -> Tensor:
        """Choose the candidates that go on.

        Args:
            active: Indices (b,) of the candidates that are still in the race, ascending.
            best_loss: Lowest loss (B,) of every candidate so far, objective units; infinity for none.
            done: Iterations that are done.
            iterations: Iterations that are planned.

        Returns:
            Indices (s,) out of `active`, ascending.
        """


class PrunerNone(Pruner):
    """Gives all candidates all iterations (paper, Algorithm 1)."""

    name = "none"

    def survivors(self, active: Tensor, best_loss: Tensor, *, done: int, iterations: int) -> Tensor:
        """All of them."""
        return active


@dataclasses.dataclass(frozen=True, kw_only=True)
class PrunerHalving(Pruner):
    """Drops the worse half again and again, so that a single candidate is left for the last half of the iterations.

    Successive halving [1]_ across all candidates of a round, however many of them fit into one batch of worlds.

    Attributes:
        least_iterations: Iterations before which none is dropped.

    References:
        .. [1] Jamieson, Talwalkar, "Non-stochastic Best Arm Identification and Hyperparameter Optimization", AISTATS 2016.
    """

    name: ClassVar[str] = "halving"
    least_iterations: int = LEAST_ITERATIONS

    def survivors(self, active: Tensor, best_loss: Tensor, *, done: int, iterations: int) -> Tensor:
        """The better ones: half of them after 1/2^rounds of the iterations, ..., one after half of the iterations."""
        if len(active) < 2:
            return active
        rounds = math.ceil(math.log2(len(best_loss)))
        passed = sum(done >= max(iterations / 2**rung, self.least_iterations) for rung in range(1, rounds + 1))
        room = max(1, math.ceil(len(best_loss) / 2**passed))
        return active[best_loss[active].argsort(stable=True)[:room]].sort().values


def make_pruner(name: str) -> Pruner:
    """The built-in pruner of a name: ``"halving"`` or ``"none"``.

    Raises:
        UnknownNameError: There is no such pruner.
    """
    made: dict[str, Pruner] = {pruner.name: pruner for pruner in (PrunerHalving(), PrunerNone())}
    if name not in made:
        raise UnknownNameError("optimizer.pruner", name, made)
    return made[name]
