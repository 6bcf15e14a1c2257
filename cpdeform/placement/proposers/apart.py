"""Every tool at a contact point of its own."""

from __future__ import annotations

from cpdeform.core.placer import Proposal
from cpdeform.placement.contact_search import ContactSearch
from cpdeform.placement.grid import ToolGrid
from cpdeform.placement.proposer import Proposer


class ProposerApart(Proposer):
    """Every tool as a single one, at a contact point of its own: of other bodies first, and away from those before."""

    name = "apart"

    def propose(self, search: ContactSearch, contact: int | None) -> list[Proposal]:
        """All tools placed, if there is room for each."""
        return [] if contact is None else place_apart(search, contact, label=self.name)


def place_apart(search: ContactSearch, contact: int, *, label: str) -> list[Proposal]:
    """Place the movable tools one after the other; the first at the given contact point."""
    poses, placed, costs = search.poses, search.fixed, []
    points = search.contacts(contact)
    for index in search.movable:
        found = None
        while found is None:
            point = next(points, None)
            if point is None:
                return []
            grid = ToolGrid(search.exploration.stage, index, search.options, poses=poses, obstacles=placed)
            found = search.best_position(grid, point)
        poses, placed = found[0], [*placed, index]
        costs.append(found[1])
    return [Proposal(pose=poses, score=search.score(sum(costs) / len(costs)), label=label, contact_particle=contact)]
