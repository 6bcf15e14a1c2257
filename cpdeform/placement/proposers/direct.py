"""A single tool where its score is best."""

from __future__ import annotations

from cpdeform.core.placer import Proposal
from cpdeform.placement.contact_search import ContactSearch
from cpdeform.placement.grid import ToolGrid
from cpdeform.placement.proposer import Proposer
from cpdeform.placement.proposers.apart import place_apart


class ProposerDirect(Proposer):
    """One tool, its rotation kept, wherever around the particle its score is best; several tools are placed apart.

    References:
        Li et al., "Contact Points Discovery for Soft-Body Manipulations with Differentiable Physics", ICLR 2022, section "Direct
        Single Tool Placement".
    """

    name = "direct"

    def propose(self, search: ContactSearch, contact: int | None) -> list[Proposal]:
        """The best position, if there is room."""
        if contact is None:
            return []
        if len(search.movable) > 1:
            return place_apart(search, contact, label=self.name)
        found = search.best_position(ToolGrid(search.exploration.stage, search.movable[0], search.options), contact)
        if found is None:
            return []
        pose, cost = found
        return [Proposal(pose=pose, score=search.score(cost), label=self.name, contact_particle=contact)]
