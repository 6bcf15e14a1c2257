"""The native optimal-transport solver: torch tensors on the outside, C++ inside."""

from __future__ import annotations

import dataclasses
import math
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from cpdeform.core.errors import InputError, MissingExtraError
from cpdeform.core.forking import prepare_for_forks
from cpdeform.core.machine import available_cores
from cpdeform.core.options import MOST_THREADS, real_number, whole_number
from cpdeform.core.ot import OTCapabilities, OTResult, OTSolver, fix_gauge
from cpdeform.ot.divergence import Potentials, Problem, check_options, usable_state

try:
    from cpdeform_native import _transport
except ImportError as error:
    raise MissingExtraError(
        "ot_solver", "native", module="cpdeform_native._transport", install="pip install cpdeform-native"
    ) from error

_ROUNDING = {torch.float32: 2.0**-24, torch.float64: 2.0**-53}


@dataclasses.dataclass(frozen=True)
class Order:
    """The order of a cloud in which neighbours in memory are neighbours in space.

    Attributes:
        numbers: The points' numbers (N,), int32, on the CPU.
        extent: Size of blocks of neighbours when the points were sorted, length units; 0 where they never were.
    """

    numbers: Tensor
    extent: float

    @classmethod
    def room(cls, count: int) -> Order:
        """Room for the order of `count` points, not sorted yet."""
        return cls(torch.empty(count, dtype=torch.int32), 0.0)

    def copy(self) -> Order:
        """An order that may be changed without changing this one."""
        return Order(self.numbers.clone(), self.extent)


@dataclasses.dataclass(frozen=True)
class OrderedPotentials(Potentials):
    """What a warm call starts from.

    Attributes:
        source_order: Order of the source, which spares sorting it again; None where unknown.
        target_order: That of the target.
    """

    source_order: Order | None = None
    target_order: Order | None = None


MOST_WARM_ERROR = 0.05
"""L1 error of the source marginal above which a warm solution is of no use: its value may be half of the right one."""


class OTSolverNative(OTSolver):
    """Debiased Sinkhorn divergence in C++ for the CPU, for the cost c(x, y) = |x - y|^p and the temperature eps = blur^p.

    The entropic problem [1]_

        OT(a, b) = min_P <P, c> + eps KL(P | a (x) b) = max_(f, g) <a, f> + <b, g>  at the fixed point                  (1)

    is debiased to S(a, b) = OT(a, b) - OT(a, a)/2 - OT(b, b)/2, with potentials f_xy - f_xx and g_xy - g_yy [2]_. No N x M
    matrix is ever held: every soft minimum is computed from the points, over blocks of sixteen neighbours, a vector register at
    a time. Pairs that carry less than 2e-7 of a point's mass are left out (6e-14 in double precision), which each pass verifies
    afterwards; at small blurs a few hundred pairs per point remain, whose lists are kept between iterations [3]_. A cold
    solution lowers the temperature step by step, on 2000 points first, and converges at each with over-relaxed
    iterations [4]_. Results do not depend on the number of threads.

    Float32 inputs are computed in single precision, sums in double, where the rounding of costs and potentials, about
    diameter^p / eps / 2^24, is below the tolerance, and otherwise in double throughout; float64 inputs always in double.

    Args:
        blur: Entropic blur, length units. Smaller is sharper and, once below the point spacing, slower to converge.
        exponent: Power p of the distance, 1 or 2.
        debias: Whether to subtract the self-terms.
        scaling: Ratio of successive blurs of a cold solution.
        tolerance: L1 error of the source marginal at which a solution counts as converged.
        iterations: Most iterations at one temperature.
        warm_iterations: Most iterations of a warm call.
        warm_tolerance: L1 error of the source marginal at which a warm call stops iterating, as an iteration without
            over-relaxation would show it.
        threads: Threads; defaults to those the process may use.
        instruction_set: ``"baseline"``, ``"avx2"`` or ``"avx512"``; defaults to the fastest that the processor has.

    Note:
        A blur far below the point spacing leaves the potentials of points that touch only their own copies nearly free. The
        marginals do not see them; a `scaling` nearer 1 and a smaller `tolerance` help. That sets `potential_tolerance`.

    Raises:
        InputError: An option is out of range, or the processor lacks the instruction set.

    References:
        .. [1] Cuturi, "Sinkhorn Distances: Lightspeed Computation of Optimal Transport", NeurIPS 2013.
        .. [2] Feydy et al., "Interpolating between Optimal Transport and MMD using Sinkhorn Divergences", AISTATS 2019.
        .. [3] Schmitzer, "Stabilized Sparse Scaling Algorithms for Entropy Regularized Transport Problems", SIAM J. Sci. Comput.,
           2019.
        .. [4] Thibault et al., "Overrelaxed Sinkhorn-Knopp Algorithm for Regularized Optimal Transport", Algorithms, 2021.
    """

    capabilities: ClassVar[OTCapabilities] = OTCapabilities(
        potentials="entropic", debiased=True, warm_start=True, devices=("cpu",), potential_tolerance=0.1
    )

    def __init__(
        self,
        *,
        blur: float = 1e-3,
        exponent: int = 1,
        debias: bool = True,
        scaling: float = 0.5,
        tolerance: float = 1e-4,
        iterations: int = 3000,
        warm_iterations: int = 40,
        warm_tolerance: float = 5e-3,
        threads: int | None = None,
        instruction_set: str | None = None,
    ) -> None:
        prepare_for_forks()
        check_options(blur=blur, exponent=exponent, tolerance=tolerance, iterations=iterations, warm_iterations=warm_iterations)
        real_number("scaling", scaling, least=1e-3, most=0.99, expected="a number between 0 and 1")
        real_number("warm_tolerance", warm_tolerance, least=1e-12, most=1.0 - 1e-12, expected="a number between 0 and 1")
        if not isinstance(debias, bool):
            raise InputError("debias", came=f"{debias!r}", expected="True or False")
        if threads is not None:
            threads = whole_number("threads", threads, least=1, most=MOST_THREADS)
        known = _transport.instruction_sets()
        if instruction_set is not None and instruction_set not in known:
            raise InputError(
                "instruction_set", came=repr(instruction_set), expected=f"one that this processor has: {', '.join(known)}"
            )
        self.blur = float(blur)
        self.exponent = int(exponent)
        self.debias = debias
        self.scaling = scaling
        self.tolerance = tolerance
        self.iterations = int(iterations)
        self.warm_iterations = int(warm_iterations)
        self.warm_tolerance = warm_tolerance
        self.threads = threads or available_cores()
        self._engine = _transport.Solver(self.threads, instruction_set or "")
        self.capabilities = dataclasses.replace(type(self).capabilities, debiased=debias)  # type: ignore[misc]

    @property
    def instruction_set(self) -> str:
        """The instruction set in use."""
        return str(self._engine.instruction_set)

    def solve(
        self,
        source: Tensor,
        target: Tensor,
        *,
        source_weights: Tensor | None = None,
        target_weights: Tensor | None = None,
        previous: OTResult | None = None,
    ) -> OTResult:
        """Solve one problem; see `OTSolver.solve`.

        With `previous`, a call makes up to `warm_iterations` iterations, the source potential first: it is the one whose points
        moved, and the target's potential, a function on unmoved points, predicts it. What they leave accumulates slowly over
        many calls, so start cold again from time to time. Where they leave a marginal error above `MOST_WARM_ERROR`, since the
        points moved too far, the call itself starts cold. Pairs below 1e-3 of a point's mass are left out, less than the
        iterations leave. The order of the points is kept until they have moved too far for it. `converged` still speaks of
        `tolerance`. A solution for tensors of another device is computed on the CPU and moved there.
        """
        problem = Problem.of(source, target, source_weights, target_weights, self.blur, self.exponent)
        if source.dtype not in _ROUNDING:
            raise InputError("source", came=f"{source.dtype}", expected="torch.float32 or torch.float64")
        state = usable_state(previous, problem, self.blur, debias=self.debias)
        result = self._solve(problem, state)
        if state is not None and not result.marginal_error <= MOST_WARM_ERROR:
            result = self._solve(problem, None)
        return result

    def _solve(self, problem: Problem, state: Potentials | None) -> OTResult:
        source, target = problem.source, problem.target
        work = self._precision(problem)

        def array(values: Tensor | None, like: Tensor) -> Tensor:
            """A contiguous copy to compute in; without values, room for them."""
            if values is None:
                return torch.empty(like.shape, dtype=work)
            return values.to(device="cpu", dtype=work, copy=True).contiguous()

        warm = state is not None
        f, g, source_self, target_self = (
            array(values, like)
            for values, like in (
                (state.source if state else None, source.weights),
                (state.target if state else None, target.weights),
                (state.source_self if state else None, source.weights),
                (state.target_self if state else None, target.weights),
            )
        )
        gradient = torch.empty(source.points.shape, dtype=work)
        inputs = (source.points, target.points, source.weights, target.weights)
        orders = self._orders(problem, state)
        count, error, *extents = self._engine.solve(
            *(np.ascontiguousarray(values.to(device="cpu", dtype=work).numpy()) for values in inputs),
            *(values.numpy() for values in (f, g, source_self, target_self, gradient)),
            exponent=self.exponent,
            blur=self.blur,
            debias=self.debias,
            scaling=self.scaling,
            tolerance=self.tolerance,
            iterations=self.iterations,
            warm=warm,
            warm_tolerance=self.warm_tolerance,
            warm_iterations=self.warm_iterations,
            same_target=state is not None and state.target_side.same_as(target),
            source_order=orders[0].numbers.numpy(),
            target_order=orders[1].numbers.numpy(),
            source_extent=orders[0].extent,
            target_extent=orders[1].extent,
        )
        orders = (dataclasses.replace(orders[0], extent=extents[0]), dataclasses.replace(orders[1], extent=extents[1]))
        return self._result(problem, (f, g, source_self, target_self), orders, gradient, int(count), float(error))

    @staticmethod
    def _orders(problem: Problem, state: Potentials | None) -> tuple[Order, Order]:
        """The clouds' orders to start from, which the solution may change, or room for them."""
        known = (state.source_order, state.target_order) if isinstance(state, OrderedPotentials) else (None, None)
        sides = (problem.source, problem.target)
        first, second = (
            order.copy() if order is not None else Order.room(side.points.shape[0])
            for order, side in zip(known, sides, strict=True)
        )
        return first, second

    def _precision(self, problem: Problem) -> torch.dtype:
        """The type to compute in: the input's, or double where single rounding would hide the tolerance."""
        dtype = problem.source.points.dtype
        rounding = _ROUNDING[dtype] * problem.diameter() ** self.exponent / problem.epsilon
        return dtype if rounding <= self.tolerance else torch.float64

    def _result(
        self,
        problem: Problem,
        solution: tuple[Tensor, Tensor, Tensor, Tensor],
        orders: tuple[Order, Order],
        gradient: Tensor,
        count: int,
        error: float,
    ) -> OTResult:
        """Debias, fix the gauge and sum up, in double precision."""
        dtype, device = problem.source.points.dtype, problem.source.points.device
        f, g, source_self, target_self = (values.double() for values in solution)
        weights, other_weights = (side.weights.to(device="cpu", dtype=torch.float64) for side in (problem.source, problem.target))
        potential, other = (f - source_self, g - target_self) if self.debias else (f, g)
        potential, other = fix_gauge(potential, other, weights)
        value = (weights * potential).sum() + (other_weights * other).sum()
        raw = [values.to(device=device, dtype=dtype) for values in solution]
        state = OrderedPotentials(
            raw[0], raw[1], raw[2] if self.debias else None, raw[3] if self.debias else None, problem.target, *orders
        )
        return OTResult(
            value=value.to(device=device, dtype=dtype),
            source_potential=potential.to(device=device, dtype=dtype),
            target_potential=other.to(device=device, dtype=dtype),
            source_gradient=gradient.to(device=device, dtype=dtype),
            converged=math.isfinite(error) and error <= self.tolerance,
            iterations=count,
            marginal_error=error,
            blur=self.blur,
            warm_state=state,
            exponent=self.exponent,
        )
