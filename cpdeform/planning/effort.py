"""How much a stage may cost, counted before it starts."""

from __future__ import annotations

import dataclasses


@dataclasses.dataclass(frozen=True)
class Effort:
    """Work between two bounds, each of one world.

    Attributes:
        gradients: Fewest and most evaluations of a loss and its gradient.
        rollouts: Fewest and most rollouts without a gradient.
    """

    gradients: tuple[int, int] = (0, 0)
    rollouts: tuple[int, int] = (0, 0)

    def __add__(self, other: Effort) -> Effort:
        return Effort(_sum(self.gradients, other.gradients), _sum(self.rollouts, other.rollouts))

    def scaled(self, least: int, most: int) -> Effort:
        """The work done at least and at most so many times."""
        return Effort(
            (least * self.gradients[0], most * self.gradients[1]),
            (least * self.rollouts[0], most * self.rollouts[1]),
        )


@dataclasses.dataclass(frozen=True, kw_only=True)
class JointEffort:
    """A descent over several stages together, once they are found.

    Attributes:
        after: Stages of the run that are over then.
        stages: Stages that it goes over; an iteration costs a gradient of each.
        iterations: Fewest and most iterations.
    """

    after: int
    stages: int
    iterations: tuple[int, int]

    @property
    def effort(self) -> Effort:
        """What it computes: gradients, and the stages executed anew at its end."""
        least, most = self.iterations
        return Effort(gradients=(self.stages * least, self.stages * most), rollouts=(self.stages, self.stages))


def _sum(first: tuple[int, int], second: tuple[int, int]) -> tuple[int, int]:
    return first[0] + second[0], first[1] + second[1]
