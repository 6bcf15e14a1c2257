"""The placer that moves nothing: PlasticineLab's own protocol."""

from __future__ import annotations

from cpdeform.core.placer import Placer, PlacerCapabilities, Proposal, Stage


class PlacerFixed(Placer):
    """Tools stay where the current state has them, also where they touch or overlap the body."""

    capabilities = PlacerCapabilities(needs_priorities=False, max_tools=None)

    def expected_proposals(self, movable: int) -> tuple[int, int]:
        """See `Placer`."""
        return 1, 1

    def ask(self, stage: Stage) -> list[Proposal]:
        """Propose the current poses as the only candidate."""
        return [Proposal(pose=stage.state.tool_pose[0].clone(), score=float("nan"), label="fixed")]
