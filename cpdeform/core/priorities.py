"""Transport priorities: how much each particle calls for a tool."""

from __future__ import annotations

import torch
from torch import Tensor

from cpdeform.core.errors import InputError
from cpdeform.core.ot import OTResult

DISPLACEMENT_EXPONENT = 2
"""Power of the distance of the cost that displacements are taken from."""


def transport_priorities(result: OTResult) -> Tensor:
    """Priorities of the source particles of a solved transport problem, all of equal weight; the cost says which.

    Cost |x - y|: the dual potential f_i, as in the paper [1]_. A potential falls along the way that mass takes, by the distance,
    whoever carries it: where clay is missing at one end of a rope and has to be passed on from particle to particle, f is largest
    at the other end, however little the clay moves there, and smallest beside the worst fault.

    Cost |x - y|^2: the distance |x_i - T(x_i)| that the transport moves a particle, from the gradient of that cost, which is
    2 (x_i - T(x_i)) / N [2]_. Zero where the clay stays.

    Args:
        result: Solution for N source particles.

    Returns:
        Priorities (N,): cost units for potentials, length units for displacements.

    References:
        .. [1] Li et al., "Contact Points Discovery for Soft-Body Manipulations with Differentiable Physics", ICLR 2022.
        .. [2] Feydy et al., "Interpolating between Optimal Transport and MMD using Sinkhorn Divergences", AISTATS 2019.
    """
    if result.exponent != DISPLACEMENT_EXPONENT:
        return result.source_potential
    distance: Tensor = torch.linalg.vector_norm(transport_displacements(result), dim=-1)
    return distance


def transport_displacements(result: OTResult) -> Tensor:
    """Where transport of the cost |x - y|^2 moves the source particles, T(x_i) - x_i (N, 3), length units.

    Raises:
        InputError: The result is not one of the squared distance.
    """
    if result.exponent != DISPLACEMENT_EXPONENT:
        raise InputError(
            "result",
            came=f"a solution of the cost |x - y|^{result.exponent}",
            expected="one of |x - y|^2, whose gradient is the displacement",
            remedy="Give the solver exponent=2 (--set priorities.kind=displacement), or take the potentials.",
        )
    return result.source_gradient * (-result.source_gradient.shape[0] / DISPLACEMENT_EXPONENT)
