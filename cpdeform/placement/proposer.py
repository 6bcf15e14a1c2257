"""The interface of proposers: one way of placing the tools around a contact point."""

from __future__ import annotations

import abc
import dataclasses
from typing import ClassVar

import torch

from cpdeform.core.placer import Proposal, Stage
from cpdeform.core.signed_distance import signed_distance
from cpdeform.placement.contact_search import ContactSearch

VARIED_DEPTH = 1e-4
"""How deep a varied tool may reach into the body, length units: less than it acts at a distance."""


class Proposer(abc.ABC):
    """One way of placing the tools, and of beginning to move them.

    `PlacerTransport` asks its proposers in turn for each contact point. To add one, write a subclass and hand an instance to it:
    ``PlacerTransport(proposers=["left-right", MyProposer()])``.

    Attributes:
        name: Label of its proposals.
        exponent: Power of the distance in the transport cost that it reads; None where priorities of either cost will do.
        blur: Entropic blur that it prefers, length units; None for the default.
        needs_contact: Whether it places the tools around the contact point that it is given. Otherwise it is asked once a round,
            or once a stage where it always proposes the same (`repeats`).
        repeats: Whether another call in the same stage may propose something else.
    """

    name: str
    exponent: ClassVar[int | None] = None
    blur: ClassVar[float | None] = None
    needs_contact: ClassVar[bool] = True
    repeats: ClassVar[bool] = True

    @abc.abstractmethod
    def propose(self, search: ContactSearch, contact: int | None) -> list[Proposal]:
        """Propose candidates free of collision with the body.

        Args:
            search: The stage, and what has been tried in it.
            contact: Index of the contact particle; None for a proposer that needs none.

        Returns:
            Proposals; empty where there is no room.
        """

    def vary(self, proposal: Proposal, stage: Stage, *, scale: float) -> Proposal | None:
        """Draw a proposal near another one: tools shifted, first actions changed.

        Args:
            proposal: What to vary; its label and contact particle stay.
            stage: The stage; its generator is drawn from.
            scale: Standard deviation of the shift along each axis, length units, and of the actions in units of action, relative
                to a tool's half width of 0.03.

        Returns:
            The variation, its score unknown; None where a tool would leave its bounds or reach into the body.
        """
        pose, generator = proposal.pose.clone(), stage.generator
        for index, tool in enumerate(stage.scene.tools):
            if tool.movable:
                pose[index, :3] += (scale * torch.randn(3, generator=generator)).to(pose)
                lower, upper = pose.new_tensor(tool.lower_bound), pose.new_tensor(tool.upper_bound)
                inside = (pose[index, :3] >= lower) & (pose[index, :3] <= upper)
                gap = signed_distance(tool, pose[index], stage.state.position[0].to(pose)).min()
                if not bool(inside.all()) or float(gap) < -VARIED_DEPTH:
                    return None
        actions = proposal.actions
        if actions is not None:
            noise = (scale / 0.03) * torch.randn(actions.shape[1], generator=generator)
            actions = (actions + noise.to(actions)).clamp(-1.0, 1.0)
        return dataclasses.replace(proposal, pose=pose, score=float("nan"), actions=actions)
