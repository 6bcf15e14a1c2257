"""The interface of strategies: which contacts are proposed, in which phases, by which losses, with which budget."""

from __future__ import annotations

import abc
import dataclasses
from collections.abc import Iterator, Mapping
from typing import Any, ClassVar

from torch import Tensor

from cpdeform.core.objective import Objective
from cpdeform.core.placer import Placer
from cpdeform.core.simulator import Simulator
from cpdeform.core.task import Task
from cpdeform.planning.algorithm import Planner, Start, contact_points_discovery
from cpdeform.planning.effort import Effort, JointEffort
from cpdeform.planning.optimizer import TrajectoryOptimizer
from cpdeform.planning.phases.descent import PhaseDescent, PhaseRefinement
from cpdeform.planning.phases.phase import Phase
from cpdeform.planning.result import Revision, StageResult


@dataclasses.dataclass(frozen=True, kw_only=True)
class Parts:
    """What the configuration of a run makes, for a strategy to put together.

    Attributes:
        task: What is to be done.
        placer: Turns priorities into proposals.
        objective: The shape loss.
        optimizer: Finds actions.
        refinement: Loss and optimiser of the refinement that the configuration asks for; None for none.
    """

    task: Task
    placer: Placer
    objective: Objective
    optimizer: TrajectoryOptimizer
    refinement: tuple[Objective, TrajectoryOptimizer] | None = None


class Strategy(abc.ABC):
    """How the stages of a run find their plans.

    A strategy answers three questions: what a run is configured with where the user says nothing (`settings`), which phases lead
    from proposals to a stage's plan (`phases`), and how one stage follows the other (`loop`). It may bring a placer of its own.
    Its constructor takes keyword options (`strategy_options` of the configuration). Register a subclass with the hook
    `cpdeform_strategies`.

    Attributes:
        keeps_limits: Whether plans keep to the limits that a task puts on its tools (`Task.limits`).
        takes_optimizer: Whether phases use `Parts.optimizer`, which the options `optimizer.*` describe; otherwise who sets one of
            them is told that it has no effect.
    """

    keeps_limits: ClassVar[bool] = True
    takes_optimizer: ClassVar[bool] = True

    @abc.abstractmethod
    def settings(self, task: Task, *, placer: str | None) -> Mapping[str, Any]:
        """Values of the configuration where the user sets nothing.

        Args:
            task: What is to be done.
            placer: Name of the placer that the user asks for; None leaves it to the strategy.

        Returns:
            Fields of `cpdeform.run.configuration.RunConfiguration`, nested.
        """

    def placer(self, named: Placer, *, task: Task) -> Placer:
        """The placer of the run; defaults to the one that the configuration names.

        Args:
            named: That one.
            task: What is to be done.
        """
        return named

    def phases(self, parts: Parts) -> tuple[Phase, ...]:
        """The steps of a stage; defaults to a descent of all candidates, and a refinement where the configuration asks for one."""
        search: tuple[Phase, ...] = (PhaseDescent(optimizer=parts.optimizer),)
        if parts.refinement is None:
            return search
        objective, optimizer = parts.refinement
        return (*search, PhaseRefinement(objective=objective, optimizer=optimizer))

    def effort(self, stage: Effort) -> Effort:
        """What a stage costs with all that the loop adds, for the estimate before a run; defaults to what its phases cost.

        Args:
            stage: What the phases cost.
        """
        return stage

    def objective(self, objective: Objective, *, simulator: Simulator, goal: Tensor) -> Objective:
        """The loss that the loop measures stages by, for those who look at a record; defaults to the one of the configuration.

        Args:
            objective: That one.
            simulator: Physics.
            goal: Goal particles (M, 3), length units.
        """
        return objective

    def joint_efforts(self, simulator: Simulator, *, stages: int) -> tuple[JointEffort, ...]:
        """What the loop computes between stages over several of them together, for the estimate; defaults to nothing.

        Args:
            simulator: Whether its gradients can be chained may decide.
            stages: Stages of the run.

        Returns:
            In the order in which they come.
        """
        return ()

    def loop(self, planner: Planner, start: Start) -> Iterator[StageResult | Revision]:
        """Lead from stage to stage, and maybe come back to some; defaults to the loop of Algorithm 1."""
        return contact_points_discovery(planner, start)
