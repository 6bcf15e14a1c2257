"""The placement interface: where to put the tools before optimising their motion."""

from __future__ import annotations

import abc
import dataclasses
from typing import ClassVar

import torch
from torch import Tensor

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
        target: Goal particles G (M, 3), length units.
        priorities: Transport priorities f (N,), cost or length units (see `transport_priorities`); nan where the
            placer declared that it needs none.
        generator: Source of randomness on the CPU, seeded by the run.
        loss: Loss of leaving the state as it is, objective units; nan where it is unknown.
        failed_contacts: Contact particles of the candidates of all stages since the last one that gained at least `LEAST_GAIN`.
        displacements: Where transport moves each particle (N, 3), length units; None where the priorities are potentials.
    """

    index: int
    scene: Scene
    state: State
    target: Tensor
    priorities: Tensor
    generator: torch.Generator
    loss: float = float("nan")
    failed_contacts: tuple[int, ...] = ()
    displacements: Tensor | None = None


@dataclasses.dataclass(frozen=True)
class Placement:
    """Poses of all tools for one candidate plan, i.e. for one world.

    Attributes:
        pose: Tool poses (M, 8); see `State.manipulator_pose`.
        score: The placement score (paper, section "Direct Single Manipulator Placement"), cost units; nan where not computed.
        label: Short name of the candidate, e.g. ``"direct"`` or ``"left-right"``.
        contact_particle: Index of the particle the tools were placed around; None where there is none.
    """

    pose: Tensor
    score: float
    label: str
    contact_particle: int | None = None


@dataclasses.dataclass(frozen=True)
class PlacementResult:
    """What became of a placement.

    Attributes:
        placement: The placement that was asked for.
        loss: Best loss of its plan, objective units.
        actions: The plan (T, A) with that loss, in [-1, 1].
        finite: Whether every loss and gradient on the way was finite; otherwise the search ended early.
    """

    placement: Placement
    loss: float
    actions: Tensor
    finite: bool = True


@dataclasses.dataclass(frozen=True)
class PlacerCapabilities:
    """What a placer declares about itself.

    Attributes:
        needs_priorities: Whether it reads `Stage.priorities`.
        max_manipulators: The most movable tools it can place; None for any number.
    """

    needs_priorities: bool
    max_manipulators: int | None


class Placer(abc.ABC):
    """Proposes candidate placements of the tools."""

    capabilities: ClassVar[PlacerCapabilities]

    @abc.abstractmethod
    def ask(self, stage: Stage) -> list[Placement]:
        """Propose candidates, solved as one batch of worlds.

        Args:
            stage: Current state, goal and priorities.

        Returns:
            Candidates free of collision with the body; empty where there is none.
        """

    def tell(self, results: list[PlacementResult]) -> bool:
        """Receive the plans found from the placements asked for last.

        Args:
            results: One entry per placement, in the order asked for.

        Returns:
            Whether to ask again in the same stage; False unless a placer searches in rounds.
        """
        return False
