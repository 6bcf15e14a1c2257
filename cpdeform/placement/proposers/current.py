"""The tools where they are."""

from __future__ import annotations

from typing import ClassVar

from cpdeform.core.placer import Proposal
from cpdeform.core.signed_distance import signed_distance
from cpdeform.placement.contact_search import ContactSearch
from cpdeform.placement.proposer import Proposer

CURRENT_DEPTH = 1e-3
"""How deep a tool that stays where it is may reach into the body, length units."""


class ProposerCurrent(Proposer):
    """The tools where they are, unless one reaches into the body."""

    name = "current"
    needs_contact: ClassVar[bool] = False
    repeats: ClassVar[bool] = False

    def propose(self, search: ContactSearch, contact: int | None) -> list[Proposal]:
        """The current poses."""
        stage, poses = search.exploration.stage, search.poses
        for tool, pose in zip(stage.scene.tools, poses, strict=True):
            if tool.movable and float(signed_distance(tool, pose, stage.state.position[0]).min()) < -CURRENT_DEPTH:
                return []
        return [Proposal(pose=poses, score=float("nan"), label=self.name)]
