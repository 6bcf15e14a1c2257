"""The interface of phases."""

from __future__ import annotations

import abc
from typing import ClassVar, Literal

from cpdeform.core.placer import Candidate
from cpdeform.planning.effort import Effort
from cpdeform.planning.workbench import Workbench

Scope = Literal["round", "search", "plan"]


class Phase(abc.ABC):
    """A step from proposals to the plan of a stage.

    A stage runs a list of phases. Those of the scope ``"round"`` work, one after the other, on all candidates of each round of
    proposals; those of the scope ``"search"`` on the candidates of all rounds, when the last one is over. The candidate of the
    lowest loss is executed. Those of the scope ``"plan"`` then work on that plan, and what they find is executed in its place where
    they accept it. To add a phase, write a subclass and put it into the list: `cpdeform.planning.strategy.Strategy.phases`.

    Attributes:
        name: Short name, told to observers with each iteration, and the key of its wall time.
        scope: ``"round"``, ``"search"`` or ``"plan"``.
    """

    name: str
    scope: ClassVar[Scope]

    @abc.abstractmethod
    def run(self, bench: Workbench, candidates: list[Candidate]) -> list[Candidate]:
        """Work on candidates.

        Args:
            bench: The stage, the simulator and the counters.
            candidates: Candidates of a round, fresh (`bench.first_actions` gives them actions) or as the phase before left them;
                of the scope ``"plan"`` the single one that was executed.

        Returns:
            Of a round or a search, the same candidates in the same order, with plans and losses; infinite losses mark those that
            the next phases leave out. Of a plan, the changed candidate, or nothing where nothing was gained.
        """

    def effort(self, candidates: int) -> Effort:
        """What `run` costs, for the estimate before a run; nothing unless overridden.

        Args:
            candidates: Number of candidates that it is given.
        """
        return Effort()

    def accepts(self, loss: float, *, loss_before: float, loss_now: float) -> bool:
        """Whether a plan that was executed counts.

        Args:
            loss: Its loss, from a fresh evaluation of the stage's objective.
            loss_before: Loss that a plan has to be below: that of the stage's state, or of what it becomes if it is left alone
                (`Planner.compared_with_rest`).
            loss_now: Loss of the plan that it would replace; `loss_before` where there is none.
        """
        return loss < loss_before
