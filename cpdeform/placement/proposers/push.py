"""Every tool behind clay of its own, on the side that the clay has to leave."""

from __future__ import annotations

from typing import ClassVar

from cpdeform.core.placer import Proposal
from cpdeform.core.priorities import DISPLACEMENT_EXPONENT
from cpdeform.placement.contact_search import ContactSearch
from cpdeform.placement.proposer import Proposer
from cpdeform.placement.push import Push, PushSearch

PUSH_SPACING = 0.5
"""Distance between the contact points of pushes, in that of other contact points: where exactly a push begins matters."""


class ProposerPush(Proposer):
    """Every tool behind clay of its own, from where it pushes it as transport wants it; see `PushSearch`."""

    name = "push"
    exponent: ClassVar[int | None] = DISPLACEMENT_EXPONENT
    needs_contact: ClassVar[bool] = False

    def propose(self, search: ContactSearch, contact: int | None) -> list[Proposal]:
        """One push of all tools, whose clay then counts as explored; nothing where there is no room for each of them."""
        exploration, poses, placed = search.exploration, search.poses, search.fixed
        pushing = PushSearch(
            tools=exploration.stage.scene.tools,
            particles=search.particles,
            displacements=exploration.stage.displacements,
            distance_scale=search.distance_scale,
            clearance=search.options.clearance,
        )
        pushes: list[Push] = []
        taken = exploration.explored.clone()
        for index in search.movable:
            push, pose = pushing.next(~taken), None
            while push is not None and pose is None:
                pose = pushing.place(push, poses, index, placed)
                taken |= exploration.near(push.contact, exploration.radius)
                push = push if pose is not None else pushing.next(~taken)
            if push is None or pose is None:
                return []
            pushing.take_off(push)
            poses[index], placed, pushes = pose, [*placed, index], [*pushes, push]
        for push in pushes:
            exploration.explore(push.contact, radius=PUSH_SPACING * exploration.radius)
        score = sum(push.score for push in pushes) / len(pushes)
        return [Proposal(pose=poses, score=score, label=self.name, contact_particle=pushes[0].contact)]
