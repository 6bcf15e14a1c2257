"""The paper's placer: the tools go where the body has to move most."""

from __future__ import annotations

from collections.abc import Sequence

from cpdeform.core.errors import InputError
from cpdeform.core.ot import TransportProblem
from cpdeform.core.placer import LEAST_GAIN, Candidate, Placer, PlacerCapabilities, Proposal, Stage
from cpdeform.placement.contact_search import ContactSearch, half_width
from cpdeform.placement.grid import GridOptions, movable_tools
from cpdeform.placement.priorities import Exploration
from cpdeform.placement.proposer import Proposer
from cpdeform.placement.proposers.names import default_proposers, make_proposers

EXPLORED_RADIUS = 2.0
"""Distance from a contact point within which particles count as explored, in half widths of the narrowest tool."""

MOST_CONTACTS = 60
"""Contact points of a stage after which no further one is looked for."""


class PlacerTransport(Placer):
    """Places the tools around the particle of largest transport priority, free of collision, where their score is highest.

    With priorities f_i and the distance d_i(x) of particle i to the surface of the tool at position x, the score is
    1/N sum_i f_i / (d_i(x)^2 + 1). A single tool is placed on a grid of positions x around that particle and then on finer
    grids around the best. Several tools are placed in pairs, once per pose: of the positions that face the particle along the
    pose's direction and touch, the first tool takes that of the best score; the second one goes to the nearest position free
    of collision on the body's other side. Boxes turn to press their broadest face. Of several bodies that of the highest mean
    priority comes first, and further pairs take the next ones. The floor is no obstacle to tools, as in PlasticineLab.

    Distances count in units of `distance_scale`. With a scale of 1, the domain's edge, d^2 << 1 for every particle: the score is
    flat, far particles' small priorities outweigh the tool's neighbourhood, and on a board with one stroke the tool lands in a
    corner of the grid. The default, a tool's radius, makes the neighbourhood count. The score depends on the gauge of the
    priorities, which is fixed by `OTResult`: zero weighted median.

    Where no candidate of a stage lowers the loss by `least_gain`, the particles around the contact point count as explored, and
    the next body or the next priority is tried; they stay explored in the following stages until one of these gains more
    (`Stage.failed_contacts`).

    Args:
        grid_size: Positions along each axis of a single tool's grids (the paper: 20).
        refinements: Number of finer grids. A tool acts on the clay only within about 0.0035 of its surface, less than the
            first grid's spacing: without refinement the plan's gradient may be zero.
        clearance: Least distance between a tool and any particle, length units.
        margin: How far beyond touching the particle a single tool's first grid reaches, length units; defaults to half of the
            tool's smallest half extent.
        distance_scale: Length that the score measures distances in; 1 is the paper's formula to the letter.
        max_gap: Largest distance between a single tool and the body beyond `clearance`, length units. The paper leaves this to
            the score, which pushes the tool off the body where priorities are negative; None does the same.
        proposers: Ways of placing the tools, by name or as objects (`cpdeform.placement.proposer.Proposer`): ``"left-right"``,
            ``"top-bottom"``, ``"front-back"`` (pairs that face each other along x, y, z), ``"direct"`` (a single tool, its rotation
            kept), ``"apart"`` (every tool at a contact point of its own), ``"push"`` (every tool behind clay of its own, on the
            side that it has to leave; reads displacements) and ``"current"`` (tools stay, unless they reach into the body).
            Defaults to ``"direct"`` for one movable tool and the first three for several.
        rounds: The most rounds of candidates in a stage.
        contacts: Contact points proposed in one round.
        least_gain: Relative gain from which a stage counts as a success.

    Raises:
        InputError: An option is out of range.

    References:
        Li et al., "Contact Points Discovery for Soft-Body Manipulations with Differentiable Physics", ICLR 2022, sections
        "Direct Single Tool Placement" and "Multiple Tool Placement With Heuristic".
    """

    capabilities = PlacerCapabilities(needs_priorities=True, max_tools=None)

    def __init__(
        self,
        *,
        grid_size: int = 20,
        refinements: int = 2,
        clearance: float = 0.0,
        margin: float | None = None,
        distance_scale: float = 0.03,
        max_gap: float | None = 0.0005,
        proposers: str | Proposer | Sequence[str | Proposer] | None = None,
        rounds: int = 3,
        contacts: int = 1,
        least_gain: float = LEAST_GAIN,
    ) -> None:
        if not 0.0 < distance_scale < float("inf"):
            raise InputError("distance_scale", came=str(distance_scale), expected="a finite number above 0")
        for name, number in (("rounds", rounds), ("contacts", contacts)):
            if number < 1:
                raise InputError(name, came=str(number), expected="at least 1")
        if not 0.0 <= least_gain < 1.0:
            raise InputError("least_gain", came=str(least_gain), expected="a share of at least 0 and below 1")
        self.options = GridOptions(
            grid_size=grid_size, refinements=refinements, clearance=clearance, margin=margin, max_gap=max_gap
        )
        self.distance_scale, self.rounds, self.contacts = distance_scale, rounds, contacts
        self.proposers = None if proposers is None else make_proposers(proposers)
        self.least_gain = least_gain
        self._search: ContactSearch | None = None

    @property
    def transport_problem(self) -> TransportProblem:
        """The problem that the proposers read: of the largest exponent and blur that one of them declares."""
        declared = self.proposers or ()
        exponents = [proposer.exponent for proposer in declared if proposer.exponent is not None]
        blurs = [proposer.blur for proposer in declared if proposer.blur is not None]
        default = TransportProblem()
        return TransportProblem(exponent=max(exponents, default=default.exponent), blur=max(blurs, default=default.blur))

    def expected_proposals(self, movable: int) -> tuple[int, int]:
        """See `Placer`; a proposer makes one around each contact point."""
        return self.contacts * len(self.proposers or default_proposers(movable)), self.rounds

    def ask(self, stage: Stage) -> list[Proposal]:
        """Propose placements by every proposer, around contact points that were not proposed before in this stage.

        Returns:
            Proposals; none where every position collides, is out of the tools' bounds or does not touch.

        Raises:
            CapabilityError: The scene has no movable tool.
            InputError: The priorities are not finite, or do not fit the particles.
        """
        search = self._search_of(stage)
        exploration = search.exploration
        proposals: list[Proposal] = []
        reached = 0
        # A contact point that no tool can reach does not use up the round.
        while reached < self.contacts and exploration.attempt < MOST_CONTACTS:
            found = self._propose(search)
            exploration.attempt += 1
            reached += any(proposal.contact_particle is not None for proposal in found)
            proposals += found
        exploration.rounds += 1
        return proposals

    def tell(self, results: list[Candidate]) -> bool:
        """Ask again as long as nothing lowered the loss and rounds are left."""
        if self._search is None:
            return False
        exploration = self._search.exploration
        enough = (1.0 - self.least_gain) * exploration.stage.loss
        gained = any(result.loss < enough for result in results)
        return not gained and exploration.rounds < self.rounds

    def _search_of(self, stage: Stage) -> ContactSearch:
        """The search of a stage, begun anew for another stage."""
        if self._search is None or self._search.exploration.stage is not stage:
            movable = movable_tools(stage)
            narrowest = min(half_width(stage.scene.tools[index]) for index in movable)
            self._search = ContactSearch(
                exploration=Exploration.begin(stage, radius=EXPLORED_RADIUS * narrowest),
                movable=tuple(movable),
                options=self.options,
                distance_scale=self.distance_scale,
            )
        return self._search

    def _propose(self, search: ContactSearch) -> list[Proposal]:
        """Proposals around the next contact point, whose surroundings then count as explored."""
        exploration, contact = search.exploration, None
        proposers = self.proposers or default_proposers(len(search.movable))
        around = any(proposer.needs_contact for proposer in proposers)
        if around:
            contact = exploration.contact(exploration.ranking[exploration.attempt % len(exploration.ranking)])
            if contact is None:
                return []
        # What always proposes the same is asked once.
        asked = [proposer for proposer in proposers if proposer.repeats or exploration.attempt == 0]
        found = [proposal for proposer in asked for proposal in proposer.propose(search, contact)]
        if contact is not None:
            exploration.explore(contact)
        elif not found:
            # Proposers that find contact points themselves have looked at all particles that are left.
            exploration.attempt = MOST_CONTACTS
        return found
