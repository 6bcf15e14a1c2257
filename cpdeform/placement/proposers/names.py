"""The built-in proposers by name."""

from __future__ import annotations

from collections.abc import Sequence

from cpdeform.core.errors import InputError
from cpdeform.placement.pose import GRASP_DIRECTIONS
from cpdeform.placement.proposer import Proposer
from cpdeform.placement.proposers.apart import ProposerApart
from cpdeform.placement.proposers.current import ProposerCurrent
from cpdeform.placement.proposers.direct import ProposerDirect
from cpdeform.placement.proposers.grasp import ProposerGrasp
from cpdeform.placement.proposers.push import ProposerPush

BUILT_IN = (
    *(ProposerGrasp(name) for name in GRASP_DIRECTIONS),
    ProposerDirect(),
    ProposerApart(),
    ProposerCurrent(),
    ProposerPush(),
)
"""Proposers keep nothing between calls, so that one of each is enough."""


def make_proposers(given: str | Proposer | Sequence[str | Proposer]) -> tuple[Proposer, ...]:
    """Proposers, given by name or as objects.

    Raises:
        InputError: A name is unknown or given twice, or there is none.
    """
    known = {proposer.name: proposer for proposer in BUILT_IN}
    entries = (given,) if isinstance(given, (str, Proposer)) else tuple(given)
    names = [entry.name if isinstance(entry, Proposer) else str(entry) for entry in entries]
    if not names:
        raise InputError("proposers", came="no proposer", expected=f"at least one of {', '.join(known)}")
    for entry, name in zip(entries, names, strict=True):
        if names.count(name) > 1 or not (isinstance(entry, Proposer) or name in known):
            raise InputError("proposers", came=", ".join(names), expected=f"distinct names out of {', '.join(known)}")
    return tuple(entry if isinstance(entry, Proposer) else known[entry] for entry in entries)


def default_proposers(movable: int) -> tuple[Proposer, ...]:
    """The paper's proposers for a number of movable tools: direct for one, grasps along the three axes for several."""
    return make_proposers("direct" if movable == 1 else tuple(GRASP_DIRECTIONS))
