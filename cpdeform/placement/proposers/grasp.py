"""Tools in pairs that face each other along an axis."""

from __future__ import annotations

import torch

from cpdeform.core.errors import UnknownNameError
from cpdeform.core.placer import Proposal
from cpdeform.placement.contact_search import ContactSearch
from cpdeform.placement.grasp import TOOLS_PER_GRASP, GraspSearch
from cpdeform.placement.pose import GRASP_DIRECTIONS
from cpdeform.placement.proposer import Proposer


class ProposerGrasp(Proposer):
    """All tools in pairs that face each other along a direction, each pair around a contact point of its own.

    Args:
        name: ``"left-right"``, ``"top-bottom"`` or ``"front-back"``: along x, y or z.

    Raises:
        UnknownNameError: There is no such direction.

    References:
        Li et al., "Contact Points Discovery for Soft-Body Manipulations with Differentiable Physics", ICLR 2022, section "Multiple
        Tool Placement With Heuristic".
    """

    def __init__(self, name: str) -> None:
        if name not in GRASP_DIRECTIONS:
            raise UnknownNameError("name", name, GRASP_DIRECTIONS)
        self.name = name

    def propose(self, search: ContactSearch, contact: int | None) -> list[Proposal]:
        """One grasp of all tools, if there is room for each pair."""
        if contact is None:
            return []
        particles, scene = search.particles, search.exploration.stage.scene
        grasps = GraspSearch(tools=scene.tools, particles=particles, clearance=search.options.clearance)
        direction = torch.tensor(GRASP_DIRECTIONS[self.name]).to(particles)
        poses, cost, placed = search.poses, search.cost(), search.fixed
        pairs = [search.movable[start : start + TOOLS_PER_GRASP] for start in range(0, len(search.movable), TOOLS_PER_GRASP)]
        costs = []
        for tools, point in zip(pairs, search.contacts(contact), strict=False):
            grasp = grasps.find(poses, tools, placed, particles[point], direction, cost)
            if grasp is None:
                return []
            poses, placed = grasp.poses, [*placed, *tools]
            costs.append(grasp.cost)
        if len(costs) < len(pairs):
            return []
        score = search.score(sum(costs) / len(costs))
        return [Proposal(pose=poses, score=score, label=self.name, contact_particle=contact)]
