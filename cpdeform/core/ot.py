"""The optimal-transport interface: one contract for all solvers."""

from __future__ import annotations

import abc
import dataclasses
from collections.abc import Sequence
from typing import ClassVar, Literal

import torch
from torch import Tensor

from cpdeform.core.errors import InputError
from cpdeform.core.portable import Portable


@dataclasses.dataclass(frozen=True)
class OTCapabilities:
    """What a solver declares about its results.

    Attributes:
        potentials: ``"entropic"`` where they are unique up to the gauge, ``"exact"`` for a vertex of the exact dual. Only
            entropic potentials are transport priorities: where source and target coincide the exact dual is free within the
            Lipschitz bound, and its maximum may lie anywhere.
        debiased: Whether value, potentials and gradient are those of the debiased Sinkhorn divergence [1]_.
        warm_start: Whether `OTSolver.solve` makes use of `previous`.
        devices: Device types that the solver computes on.
        potential_tolerance: Largest difference, as a fraction of the potentials' range (max - min), from the potentials of
            the converged entropic problem of the same blur.

    References:
        .. [1] Feydy et al., "Interpolating between Optimal Transport and MMD using Sinkhorn Divergences", AISTATS 2019.
    """

    potentials: Literal["entropic", "exact"]
    debiased: bool
    warm_start: bool
    devices: tuple[str, ...]
    potential_tolerance: float


@dataclasses.dataclass(frozen=True)
class OTResult:
    """A solved transport problem between N source and M target points, cost |x - y|^p.

    Attributes:
        value: Transport cost (scalar tensor), in units of length^p.
        source_potential: Dual potential f (N,) in cost units, gauge: its weighted median is zero. Where the shapes agree it is
            zero; the larger it is, the farther that point has to move. The paper's transport priority.
        target_potential: Dual potential g (M,) in cost units, shifted by the same constant the other way, so that
            sum(a f) + sum(b g) equals `value`.
        source_gradient: Gradient (N, 3) of `value` with respect to the source positions.
        converged: Whether the solver's own stopping criterion was met within its iteration limit.
        iterations: Iterations used.
        marginal_error: Violation of the source marginal in the L1 norm, dimensionless; nan where the solver does not know.
        blur: Entropic blur, length units (0 for an exact solution).
        warm_state: What `solve(previous=...)` uses beyond the fields above; opaque, owned by the solver.
        exponent: Power p of the distance in the cost.
    """

    value: Tensor
    source_potential: Tensor
    target_potential: Tensor
    source_gradient: Tensor
    converged: bool
    iterations: int
    marginal_error: float
    blur: float
    warm_state: object = None
    exponent: int = 1


@dataclasses.dataclass(frozen=True)
class TransportProblem:
    """The transport problem that contact points are read from.

    Attributes:
        exponent: Power p of the distance in the cost |x - y|^p: 1 for potentials as priorities (the paper), 2 for displacements.
        blur: Entropic blur, length units. The larger, the quicker and the smoother; up to half a centimetre the potentials' peak
            stays at the particles that have to move, displacements allow for two.
        tolerance: Error of the marginals that is good enough, for solvers that have the option; None leaves it to them.
    """

    exponent: int = 1
    blur: float = 5e-3
    tolerance: float | None = None


LEAST_RELATIVE_BLUR = 1e-6
"""The least entropic blur as a part of the points' span. Costs of size (span / blur)^p, in units of the temperature, leave double
precision hardly any digits below."""


class OTSolver(Portable, abc.ABC):
    """Solves optimal transport between two weighted particle clouds.

    Example:
        A cloud that is shifted by 0.1: the cost is that distance (times 1, the mass), and its gradient pulls back.

        >>> from cpdeform.ot.pot import OTSolverPOT
        >>> target = torch.rand(50, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        >>> result = OTSolverPOT(blur=1e-3).solve(target + torch.tensor([0.1, 0.0, 0.0]), target)
        >>> round(float(result.value), 3), result.source_potential.shape, result.converged
        (0.1, torch.Size([50]), True)
    """

    capabilities: ClassVar[OTCapabilities]

    @abc.abstractmethod
    def solve(
        self,
        source: Tensor,
        target: Tensor,
        *,
        source_weights: Tensor | None = None,
        target_weights: Tensor | None = None,
        previous: OTResult | None = None,
    ) -> OTResult:
        """Solve one problem.

        Args:
            source: Source positions (N, 3), length units.
            target: Target positions (M, 3), length units, same device and type.
            source_weights: Non-negative weights (N,) summing to 1; defaults to uniform ones.
            target_weights: Non-negative weights (M,) summing to 1; defaults to uniform ones.
            previous: Result of a nearby problem of the same sizes, to start from.

        Returns:
            Value, potentials and gradient, detached, on the device and in the type of `source`.

        Raises:
            InputError: Shapes, devices or weights do not fit, a number is not finite, or the blur is next to nothing against the
                points' span (`check_blur`).
        """

    def solve_batch(self, sources: Tensor, target: Tensor, *, previous: Sequence[OTResult | None] | None = None) -> list[OTResult]:
        """Solve one problem a world, all with the same target and uniform weights.

        Args:
            sources: Source positions (B, N, 3), length units.
            target: Target positions (M, 3), length units, same device and type.
            previous: A result of a nearby problem for each world, to start from, or None for a world without.

        Returns:
            The solution of each world, as `solve` gives it; the default solves one after the other.

        Raises:
            InputError: As for `solve`, or `previous` has another length than the batch.
        """
        starts = [None] * len(sources) if previous is None else list(previous)
        if len(starts) != len(sources):
            raise InputError("previous", came=f"{len(starts)} results", expected=f"{len(sources)}, one for each world")
        return [self.solve(source, target, previous=start) for source, start in zip(sources, starts, strict=True)]


def weighted_median(values: Tensor, weights: Tensor) -> Tensor:
    """Lower weighted median (scalar tensor) of `values` (N,) under non-negative `weights` (N,)."""
    order = torch.argsort(values)
    cumulative = torch.cumsum(weights[order], dim=0)
    index = torch.searchsorted(cumulative, 0.5 * cumulative[-1]).clamp(max=values.numel() - 1)
    return values[order][index]


def fix_gauge(source_potential: Tensor, target_potential: Tensor, source_weights: Tensor) -> tuple[Tensor, Tensor]:
    """Shift potentials (N,), (M,) to the one gauge: the weighted median of the source potential is zero."""
    shift = weighted_median(source_potential, source_weights)
    return source_potential - shift, target_potential + shift


def check_problem(
    source: Tensor, target: Tensor, source_weights: Tensor | None, target_weights: Tensor | None
) -> tuple[Tensor, Tensor]:
    """Validate the arguments of `OTSolver.solve` and fill in uniform weights.

    Returns:
        Source weights (N,) and target weights (M,), each summing to 1.

    Raises:
        InputError: Shapes, devices, types or weights do not fit, or a number is not finite.
    """
    for name, points in (("source", source), ("target", target)):
        if points.ndim != 2 or points.shape[1] != 3 or points.shape[0] == 0:
            raise InputError(name, came=f"shape {tuple(points.shape)}", expected="shape (points, 3) with at least one point")
        if not bool(torch.isfinite(points).all()):
            bad = int((~torch.isfinite(points)).any(dim=1).sum())
            raise InputError(name, came=f"{bad} points with nan or infinity", expected="finite positions")
    if source.device != target.device or source.dtype != target.dtype:
        raise InputError(
            "target", came=f"{target.dtype} on {target.device}", expected=f"{source.dtype} on {source.device}, as the source"
        )
    return _check_weights("source_weights", source_weights, source), _check_weights("target_weights", target_weights, target)


def check_blur(blur: float, source: Tensor, target: Tensor) -> None:
    """Refuse a blur that is next to nothing against the points: no solver could resolve it, and some would never end.

    Args:
        blur: Entropic blur, length units.
        source: Finite source positions (N, 3), length units.
        target: Finite target positions (M, 3), length units.

    Raises:
        InputError: The blur is below `LEAST_RELATIVE_BLUR` of the diagonal of the box around all points.
    """
    low = torch.minimum(source.amin(dim=0), target.amin(dim=0)).double()
    high = torch.maximum(source.amax(dim=0), target.amax(dim=0)).double()
    span = float((high - low).detach().norm())
    if not blur >= LEAST_RELATIVE_BLUR * span:
        raise InputError(
            "blur",
            came=f"{blur:g} for points that span {span:g}",
            expected=f"at least {LEAST_RELATIVE_BLUR * span:g}, a millionth of the span",
            remedy="Usual values lie between 1e-3 and 1e-2 of a domain edge; positions are in domain edges.",
        )


def _check_weights(name: str, weights: Tensor | None, points: Tensor) -> Tensor:
    count = points.shape[0]
    if weights is None:
        return torch.full((count,), 1.0 / count, dtype=points.dtype, device=points.device)
    if weights.shape != (count,):
        raise InputError(name, came=f"shape {tuple(weights.shape)}", expected=f"shape ({count},)")
    if not bool(torch.isfinite(weights).all()) or bool((weights < 0).any()):
        raise InputError(name, came="negative or non-finite entries", expected="non-negative finite weights")
    total = float(weights.sum())
    if abs(total - 1.0) > 1e-3:
        raise InputError(name, came=f"a sum of {total:.6g}", expected="a sum of 1", remedy="Divide the weights by their sum.")
    return weights.to(points)
