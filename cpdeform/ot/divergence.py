"""What both solvers share: the problem, and the step from potentials to a result of the common contract."""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from cpdeform.core.errors import InputError
from cpdeform.core.options import real_number, whole_number
from cpdeform.core.ot import OTResult, check_blur, check_problem, fix_gauge
from cpdeform.ot.softmin import soft_minimum, soft_minimum_gradient

LEAST_BLUR = 1e-6
"""Smallest blur, length units: a thousandth of the distance between particles; below it a solution takes hours."""

MOST_ITERATIONS = 1_000_000


@dataclasses.dataclass(frozen=True)
class Side:
    """A weighted cloud: points (N, 3), weights (N,) and their logarithms (N,)."""

    points: Tensor
    weights: Tensor
    log_weights: Tensor

    @classmethod
    def of(cls, points: Tensor, weights: Tensor) -> Side:
        """Detach and normalise: the weights may sum to 1 only roughly, which potentials would amplify."""
        weights = weights.detach() / weights.detach().sum()
        return cls(points.detach(), weights, weights.log())

    def subset(self, index: Tensor) -> Side:
        """The points of `index` (K,), with weights made to sum to 1."""
        return Side.of(self.points[index], self.weights[index])

    def to(self, dtype: torch.dtype) -> Side:
        """The same cloud in another type."""
        return Side.of(self.points.to(dtype), self.weights.to(dtype))

    def same_as(self, other: Side) -> bool:
        """Whether the two are equal in every number, so that a potential of one serves the other."""
        if self.points is other.points and self.weights is other.weights:
            return True
        return torch.equal(self.points, other.points) and torch.equal(self.weights, other.weights)


@dataclasses.dataclass(frozen=True)
class Problem:
    """Two clouds, the temperature (cost units) and the power of the cost."""

    source: Side
    target: Side
    epsilon: float
    exponent: int

    @classmethod
    def of(
        cls,
        source: Tensor,
        target: Tensor,
        source_weights: Tensor | None,
        target_weights: Tensor | None,
        blur: float,
        exponent: int,
    ) -> Problem:
        """Check the arguments of `OTSolver.solve` and gather them."""
        first, second = check_problem(source, target, source_weights, target_weights)
        check_blur(blur, source, target)
        return cls(Side.of(source, first), Side.of(target, second), blur**exponent, exponent)

    def diameter(self) -> float:
        """Diagonal of the box around both clouds, length units."""
        points = torch.cat([self.source.points, self.target.points])
        return float((points.amax(dim=0) - points.amin(dim=0)).norm())

    def at(self, epsilon: float) -> Problem:
        """The same problem at another temperature."""
        return dataclasses.replace(self, epsilon=epsilon)

    def source_update(self, target_potential: Tensor) -> Tensor:
        """Source potential (N,) from the target's (M,): half a Sinkhorn iteration."""
        side = self.target
        return soft_minimum(
            self.source.points, side.points, side.log_weights, target_potential, epsilon=self.epsilon, exponent=self.exponent
        )

    def source_update_gradient(self, target_potential: Tensor) -> tuple[Tensor, Tensor]:
        """`source_update`, and the gradient (N, 3) of each value with respect to its point."""
        side = self.target
        return soft_minimum_gradient(
            self.source.points, side.points, side.log_weights, target_potential, epsilon=self.epsilon, exponent=self.exponent
        )

    def target_update(self, source_potential: Tensor) -> Tensor:
        """Target potential (M,) from the source's (N,): the other half."""
        side = self.source
        return soft_minimum(
            self.target.points, side.points, side.log_weights, source_potential, epsilon=self.epsilon, exponent=self.exponent
        )

    def source_error(self, potential: Tensor, updated: Tensor) -> float:
        """L1 error of the source marginal before an update changed the source potential from `potential` to `updated`."""
        change = ((potential - updated) / self.epsilon).clamp(max=50.0)
        return float((self.source.weights * torch.expm1(change).abs()).sum())

    def self_problem(self, side: Side) -> Problem:
        """The transport of a cloud to itself, which debiasing subtracts."""
        return Problem(side, side, self.epsilon, self.exponent)


@dataclasses.dataclass(frozen=True)
class Potentials:
    """Solved, still biased potentials and the self-potentials that debias them.

    Attributes:
        source: f_xy (N,), cost units.
        target: g_xy (M,), cost units.
        source_self: f_xx (N,); None without debiasing.
        target_self: g_yy (M,); None without debiasing.
        target_side: The target that `target_self` belongs to, so that the next call may reuse it.
    """

    source: Tensor
    target: Tensor
    source_self: Tensor | None
    target_self: Tensor | None
    target_side: Side


def check_options(*, blur: float, exponent: int, tolerance: float, iterations: int, warm_iterations: int) -> None:
    """Raise InputError for options out of range."""
    remedy = "Usual values lie between 1e-3 and 1e-2."
    real_number("blur", blur, least=LEAST_BLUR, most=1000.0, expected="a positive length", remedy=remedy)
    if isinstance(exponent, bool) or exponent not in (1, 2):
        raise InputError("exponent", came=f"{exponent}", expected="1 or 2")
    real_number("tolerance", tolerance, least=1e-12, most=1.0 - 1e-12, expected="a number between 0 and 1")
    for name, count in (("iterations", iterations), ("warm_iterations", warm_iterations)):
        whole_number(name, count, least=1, most=MOST_ITERATIONS)


def check_choice(name: str, value: str, allowed: tuple[str, ...]) -> None:
    """Raise InputError unless `value` is one of `allowed`."""
    if value not in allowed:
        raise InputError(name, came=f'"{value}"', expected=" or ".join(f'"{choice}"' for choice in allowed))


def usable_state(previous: OTResult | None, problem: Problem, blur: float, *, debias: bool) -> Potentials | None:
    """The potentials to start from, or None where `previous` is absent or belongs to another blur or debiasing.

    Raises:
        InputError: `previous` is of other sizes, or another kind of solver made it.
    """
    if previous is None:
        return None
    state = previous.warm_state
    if not isinstance(state, Potentials):
        raise InputError("previous", came="a result without this solver's state", expected="a result of the same solver")
    sizes = (state.source.shape[0], state.target.shape[0])
    expected = (problem.source.points.shape[0], problem.target.points.shape[0])
    if sizes != expected:
        raise InputError("previous", came=f"a problem of {sizes} points", expected=f"{expected} points, as this one")
    points = problem.source.points
    if previous.blur != blur or (state.source_self is not None) != debias:
        return None
    return state if state.source.dtype == points.dtype and state.source.device == points.device else None


def symmetric_update(problem: Problem, potential: Tensor) -> Tensor:
    """One averaged iteration of the self-problem, f <- (f + softmin(f)) / 2, which contracts fast [1]_.

    References:
        .. [1] Feydy et al., "Interpolating between Optimal Transport and MMD using Sinkhorn Divergences", AISTATS 2019.
    """
    return 0.5 * (potential + problem.source_update(potential))


def warm_potentials(problem: Problem, state: Potentials, iterations: int) -> Potentials:
    """Self-potentials for a warm call: the target's is reused while the target is unchanged, the source's is updated."""
    source_self, target_self = state.source_self, state.target_self
    if source_self is not None and target_self is not None:
        itself = problem.self_problem(problem.source)
        for _ in range(iterations):
            source_self = symmetric_update(itself, source_self)
        if not state.target_side.same_as(problem.target):
            itself = problem.self_problem(problem.target)
            for _ in range(iterations + 1):
                target_self = symmetric_update(itself, target_self)
    return dataclasses.replace(state, source_self=source_self, target_self=target_self, target_side=problem.target)


def finish(problem: Problem, potentials: Potentials, *, blur: float, tolerance: float, iterations: int) -> OTResult:
    """Last source update, gradient, debiasing and gauge.

    The last update f = softmin(g) makes <a, f> + <b, g> the dual value for this g, a lower bound of the entropic cost, and
    the normalised terms of the soft minimum its exact gradient. What the update changes is the source marginal's error.
    """
    source, target = problem.source, problem.target
    updated, gradient = problem.source_update_gradient(potentials.target)
    error = problem.source_error(potentials.source, updated)
    potentials = dataclasses.replace(potentials, source=updated)
    source_potential, target_potential = updated, potentials.target
    target_self = potentials.target_self
    if potentials.source_self is not None and target_self is not None:
        updated_self, gradient_self = problem.self_problem(source).source_update_gradient(potentials.source_self)
        gradient = gradient - gradient_self
        potentials = dataclasses.replace(potentials, source_self=updated_self)
        source_potential = source_potential - updated_self
        target_potential = target_potential - target_self
    source_potential, target_potential = fix_gauge(source_potential, target_potential, source.weights)
    value = (source.weights * source_potential).sum() + (target.weights * target_potential).sum()
    return OTResult(
        value=value,
        source_potential=source_potential,
        target_potential=target_potential,
        source_gradient=source.weights[:, None] * gradient,
        converged=error <= tolerance,
        iterations=iterations,
        marginal_error=error,
        blur=blur,
        warm_state=potentials,
        exponent=problem.exponent,
    )
