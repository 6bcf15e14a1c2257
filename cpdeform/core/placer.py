"""The placement interface: where to put the tools, and how they begin to move, before their motion is optimised."""

from __future__ import annotations

import abc
import dataclasses
from typing import ClassVar

import torch
from torch import Tensor

from cpdeform.core.errors import InputError
from cpdeform.core.ot import OTResult, TransportProblem
from cpdeform.core.priorities import transport_displacements, transport_priorities
from cpdeform.core.scene import Scene
from cpdeform.core.state import State

LEAST_GAIN = 0.01
"""Relative gain of a stage's loss below which its contact points count as failed."""


@dataclasses.dataclass(frozen=True)
class Stage:
    """What a placer knows when a stage of Algorithm 1 begins.

    Attributes:
        index: Number of the stage, from 0.
        scene: The scene.
        state: The current state S_i, a single world.
        goal: Goal particles G (M, 3), length units.
        transport: Solution of the placer's `Placer.transport_problem` from the N particles to the goal; None for a placer
            without one.
        generator: Source of randomness on the CPU, seeded by the run.
        loss: Loss of leaving the state as it is, objective units; nan where it is unknown.
        failed_contacts: Contact particles of the candidates of all stages since the last one that gained at least `LEAST_GAIN`.
        step_count: Environment steps T of the stage in which the tools act.
    """

    index: int
    scene: Scene
    state: State
    goal: Tensor
    transport: OTResult | None
    generator: torch.Generator
    loss: float = float("nan")
    failed_contacts: tuple[int, ...] = ()
    step_count: int = 10

    @property
    def priorities(self) -> Tensor:
        """Transport priorities f (N,), cost or length units, see `transport_priorities`; nan without a transport problem."""
        if self.transport is None:
            return torch.full_like(self.state.position[0, :, 0], torch.nan)
        return transport_priorities(self.transport)

    @property
    def displacements(self) -> Tensor:
        """Where transport moves each particle (N, 3), length units.

        Raises:
            InputError: There is no transport problem, or it is not one of the squared distance.
        """
        if self.transport is None:
            raise InputError(
                "stage.transport",
                came="None",
                expected="a solved transport problem",
                remedy="Declare it: the placer's transport_problem.",
            )
        return transport_displacements(self.transport)


@dataclasses.dataclass(frozen=True)
class Proposal:
    """A candidate plan to begin with: poses of all tools, and how they begin to move. It becomes one world.

    Attributes:
        pose: Tool poses (M, 8); see `State.tool_pose`.
        score: The placement score (paper, section "Direct Single Tool Placement"), cost units; nan where not computed.
        label: Short name of the candidate, e.g. ``"direct"`` or ``"left-right"``.
        contact_particle: Index of the particle the tools were placed around; None where there is none.
        actions: First actions (T, A) in [-1, 1] of the steps in which the tools act; None leaves them to the optimiser.
    """

    pose: Tensor
    score: float
    label: str
    contact_particle: int | None = None
    actions: Tensor | None = None


@dataclasses.dataclass(frozen=True)
class Candidate:
    """A proposal and what became of it.

    Attributes:
        proposal: What was proposed.
        loss: Best loss of its plan, objective units; nan before it was tried.
        actions: The plan (T, A) with that loss, in [-1, 1], rest included.
        finite: Whether every loss and gradient on the way was finite; otherwise the search ended early.
    """

    proposal: Proposal
    loss: float
    actions: Tensor
    finite: bool = True


@dataclasses.dataclass(frozen=True)
class PlacerCapabilities:
    """What a placer declares about itself.

    Attributes:
        needs_priorities: Whether it reads `Stage.priorities`.
        max_tools: The most movable tools it can place; None for any number.
    """

    needs_priorities: bool
    max_tools: int | None


class Placer(abc.ABC):
    """Proposes candidate placements of the tools.

    Example:
        A placer that lifts all tools a little:

        >>> class PlacerLifted(Placer):
        ...     capabilities = PlacerCapabilities(needs_priorities=False, max_tools=None)
        ...
        ...     def ask(self, stage):
        ...         pose = stage.state.tool_pose[0].clone()
        ...         pose[:, 1] += 0.05
        ...         return [Proposal(pose=pose, score=float("nan"), label="lifted")]
        >>> from cpdeform import load_task
        >>> from cpdeform.core.state import initial_state
        >>> task = load_task("writer")
        >>> state = initial_state(task.scene)
        >>> goal = torch.as_tensor(task.load_goal())
        >>> stage = Stage(
        ...     index=0, scene=task.scene, state=state, goal=goal, transport=None, generator=torch.Generator(), loss=1.0
        ... )
        >>> [proposal] = PlacerLifted().ask(stage)
        >>> f"{float(proposal.pose[0, 1] - state.tool_pose[0, 0, 1]):.3f}"
        '0.050'
    """

    capabilities: ClassVar[PlacerCapabilities]

    @property
    def transport_problem(self) -> TransportProblem | None:
        """The transport problem whose solution `Stage.transport` holds; None where the placer needs no priorities."""
        return TransportProblem() if self.capabilities.needs_priorities else None

    def expected_proposals(self, movable: int) -> tuple[int, int]:
        """Proposals of a round, about, and rounds of a stage, at most, for the estimate before a run.

        Args:
            movable: Number of movable tools.
        """
        return 4, 1

    @abc.abstractmethod
    def ask(self, stage: Stage) -> list[Proposal]:
        """Propose candidates; they share the budget of a round.

        Args:
            stage: Current state, goal and priorities.

        Returns:
            Proposals free of collision with the body; empty where there is none.
        """

    def tell(self, results: list[Candidate]) -> bool:
        """Receive the plans found from the proposals asked for last.

        Args:
            results: One entry per proposal, in the order asked for. The loss of one that a phase of the search has left out is
                infinite.

        Returns:
            Whether to ask again in the same stage; False unless a placer searches in rounds.
        """
        return False
