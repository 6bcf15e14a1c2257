"""A proposer: the tool above the contact point, pressing down from there."""

from __future__ import annotations

import torch

from cpdeform import Proposal, Proposer
from cpdeform.core.clearance import exit_distances
from cpdeform.placement.contact_search import ContactSearch

REACH = 0.5
"""How far above the contact point the tool may have to begin, length units."""


class ProposerAbove(Proposer):
    """Lifts the first movable tool straight up from the contact point until it is free, and lets it press down at first.

    Args:
        speed: First actions along y, in [0, 1].
        steps: Number of environment steps in which the tools act.
    """

    name = "above"

    def __init__(self, *, speed: float, steps: int) -> None:
        self.speed, self.steps = speed, steps

    def propose(self, search: ContactSearch, contact: int | None) -> list[Proposal]:
        """One proposal, unless the tool would leave its bounds."""
        if contact is None:
            return []
        scene, poses, index = search.exploration.stage.scene, search.poses, search.movable[0]
        tool, up, start = scene.tools[index], poses.new_tensor([0.0, 1.0, 0.0]), search.particles[contact]
        height = exit_distances(tool, poses[index, 3:7], start.unsqueeze(0), up, search.particles, reach=REACH)[0]
        poses[index, :3] = start + height * up
        if not bool(torch.isfinite(height)) or bool((poses[index, :3] > poses.new_tensor(tool.upper_bound)).any()):
            return []
        actions = torch.zeros(self.steps, scene.action_size)
        actions[:, 1] = -self.speed
        return [Proposal(pose=poses, score=float("nan"), label=self.name, contact_particle=contact, actions=actions)]
