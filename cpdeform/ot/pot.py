"""Optimal transport with POT (Python Optimal Transport): annealed Sinkhorn potentials, optionally the exact cost."""

from __future__ import annotations

import dataclasses
import math
import warnings
from typing import ClassVar, Literal

import ot
import torch
from torch import Tensor

from cpdeform.core.forking import prepare_for_forks
from cpdeform.core.options import real_number
from cpdeform.core.ot import OTCapabilities, OTResult, OTSolver
from cpdeform.ot.annealing import Schedule, solve_cold
from cpdeform.ot.divergence import Problem, check_choice, check_options, finish, usable_state, warm_potentials
from cpdeform.ot.softmin import pair_cost

_START = 0.25  # first blur, as a fraction of the diameter
_EXACT_PIVOTS = 10_000_000


class OTSolverPOT(OTSolver):
    """Sinkhorn potentials of POT [1]_, for the cost c(x, y) = |x - y|^p and the temperature eps = blur^p.

    POT maximises the entropic dual [2]_ relative to the counting measure and returns scalings, P_ij = exp(log u_i + log v_j -
    c_ij / eps). The potentials of the common contract are relative to the product of the weights a and b:

        f_i = eps (log u_i - log a_i),  g_j = eps (log v_j - log b_j),                                                  (1)

    debiased to f_xy - f_xx and g_xy - g_yy [3]_. Every temperature of the annealing is solved by `ot.sinkhorn` with a warm
    start; the schedule, the self-potentials (POT has no symmetric solver) and the last update with its gradient are ours.
    POT computes on dense float64 matrices: five of them, 4 GB at 10,000 points. A point of weight zero takes part in
    the last update only.

    With ``value="exact"`` value and gradient are those of the unregularised problem, from `ot.emd`. The potentials stay
    entropic: the exact dual is not unique, and where source and target coincide its maximum may lie anywhere. The target
    potential is shifted by a constant so that <a, f> + <b, g> still equals the value.

    Args:
        blur: Entropic blur, length units. Smaller is sharper and slower.
        exponent: Power p of the distance, 1 or 2.
        debias: Whether to subtract the self-terms.
        value: ``"entropic"``, or ``"exact"`` for the unregularised cost (seconds at 2,000 points, a minute at 10,000).
        method: POT's algorithm for cold solves: ``"sinkhorn_stabilized"`` multiplies by a kernel that absorbs the potentials,
            ``"sinkhorn_log"`` works on logarithms throughout, some ten times slower. Warm calls always use the latter.
        scaling: Ratio of successive blurs.
        tolerance: L1 error of the source marginal at which a solution counts as converged.
        iterations: Most iterations at one temperature.
        warm_iterations: Iterations of a warm call.

    Note:
        A blur far below the point spacing leaves the potentials of points that touch only their own copies nearly free. The
        marginals hardly see them; a tighter `tolerance` and a `scaling` nearer 1 help. That, not the marginals,
        sets `potential_tolerance`: 0.05-0.08 measured on a pen stroke, 0.003 between unrelated clouds.

    Raises:
        InputError: An option is out of range.

    References:
        .. [1] Flamary et al., "POT: Python Optimal Transport", JMLR 2021.
        .. [2] Cuturi, "Sinkhorn Distances: Lightspeed Computation of Optimal Transport", NeurIPS 2013; Peyré & Cuturi,
           "Computational Optimal Transport", Foundations and Trends in Machine Learning, 2019.
        .. [3] Feydy et al., "Interpolating between Optimal Transport and MMD using Sinkhorn Divergences", AISTATS 2019.
    """

    capabilities: ClassVar[OTCapabilities] = OTCapabilities(
        potentials="entropic", debiased=True, warm_start=True, devices=("cpu", "cuda"), potential_tolerance=0.1
    )

    def __init__(
        self,
        *,
        blur: float = 1e-3,
        exponent: int = 1,
        debias: bool = True,
        value: Literal["entropic", "exact"] = "entropic",
        method: Literal["sinkhorn_stabilized", "sinkhorn_log"] = "sinkhorn_stabilized",
        scaling: float = 0.5,
        tolerance: float = 1e-4,
        iterations: int = 3000,
        warm_iterations: int = 1,
    ) -> None:
        prepare_for_forks()
        check_options(blur=blur, exponent=exponent, tolerance=tolerance, iterations=iterations, warm_iterations=warm_iterations)
        check_choice("value", value, ("entropic", "exact"))
        check_choice("method", method, ("sinkhorn_stabilized", "sinkhorn_log"))
        real_number("scaling", scaling, least=1e-3, most=0.99, expected="a number between 0 and 1")
        self.blur = float(blur)
        self.exponent = exponent
        self.debias = debias
        self.value = value
        self.method = method
        self.scaling = scaling
        self.tolerance = tolerance
        self.iterations = iterations
        self.warm_iterations = warm_iterations
        self.capabilities = dataclasses.replace(  # type: ignore[misc]  # what this instance does, within what the class declares
            type(self).capabilities, debiased=debias
        )

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

        With `previous`, a call makes `warm_iterations` iterations of POT's log-domain Sinkhorn, the source potential first: it
        is the one whose points moved. Errors accumulate slowly over many calls, so start cold again from time to time.
        """
        with torch.no_grad():
            problem = Problem.of(source, target, source_weights, target_weights, self.blur, self.exponent)
            state = usable_state(previous, problem, self.blur, debias=self.debias)
            if state is None:
                schedule = Schedule(_START, self.scaling, self.tolerance, self.iterations)
                potentials, count = solve_cold(problem, schedule, _zeros, self._descent)
                if not self.debias:
                    potentials = dataclasses.replace(potentials, source_self=None, target_self=None)
            else:
                count = self.warm_iterations
                potentials = warm_potentials(problem, state, count)
                f, g, _ = _sinkhorn(problem, potentials.source, potentials.target, "sinkhorn_log", 0.0, count)
                potentials = dataclasses.replace(potentials, source=f, target=g)
            result = finish(problem, potentials, blur=self.blur, tolerance=self.tolerance, iterations=count)
            return _with_exact_value(problem, result) if self.value == "exact" else result

    def _descent(self, problem: Problem, f: Tensor, g: Tensor, tolerance: float, limit: int) -> tuple[Tensor, Tensor, int]:
        return _sinkhorn(problem, f, g, self.method, tolerance, limit)


def _zeros(problem: Problem) -> tuple[Tensor, Tensor]:
    return torch.zeros_like(problem.source.weights), torch.zeros_like(problem.target.weights)


def _sinkhorn(problem: Problem, f: Tensor, g: Tensor, method: str, tolerance: float, limit: int) -> tuple[Tensor, Tensor, int]:
    """Run `ot.sinkhorn` from the potentials f (N,), g (M,), the source's first.

    POT updates the second marginal's scaling first, so source and target change places. In the other direction equation (1)
    makes log u the warm start of the logarithmic solver. The stabilised one starts from u = v = 1/dimension on top of the
    potentials it is given; the starting potentials undo that.
    """
    source, target = problem.source, problem.target
    kept, served = source.weights > 0, target.weights > 0
    a, b = source.weights[kept].double(), target.weights[served].double()
    a, b = a / a.sum(), b / b.sum()
    cost = pair_cost(target.points[served].double(), source.points[kept].double(), problem.exponent)
    epsilon = problem.epsilon
    log_u, log_v = f[kept].double() / epsilon + a.log(), g[served].double() / epsilon + b.log()
    if method == "sinkhorn_log":
        start = (log_v, log_u)
    else:
        start = (epsilon * (log_v + math.log(b.numel())), epsilon * (log_u + math.log(a.numel())))
    threshold = tolerance / math.sqrt(a.numel())  # POT measures in the L2 norm, which bounds L1 / sqrt(N)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Numerical errors", category=UserWarning)  # `finish` judges the marginals
        _, log = ot.sinkhorn(
            b, a, cost, epsilon, method=method, numItermax=limit, stopThr=threshold, warmstart=start, log=True, warn=False
        )
    if method == "sinkhorn_log":
        log_v, log_u, used = log["log_u"], log["log_v"], log["niter"] + 1
    else:
        log_v, log_u, used = log["alpha"] / epsilon, log["beta"] / epsilon, log["n_iter"] + 1
    f_kept, g_served = epsilon * (log_u - a.log()), epsilon * (log_v - b.log())
    if bool(kept.all()) and bool(served.all()):
        return f_kept.to(f), g_served.to(g), used
    f, g = f.clone(), g.clone()
    f[kept], g[served] = f_kept.to(f), g_served.to(g)
    return problem.source_update(g) if not bool(kept.all()) else f, problem.target_update(f), used


def _with_exact_value(problem: Problem, result: OTResult) -> OTResult:
    """Replace value and gradient by those of the exact plan of `ot.emd`."""
    source, target = problem.source, problem.target
    cost = pair_cost(source.points.double(), target.points.double(), problem.exponent)
    a, b = source.weights.double(), target.weights.double()
    plan, log = ot.emd(
        (a / a.sum()).cpu().numpy(), (b / b.sum()).cpu().numpy(), cost.cpu().numpy(), numItermax=_EXACT_PIVOTS, log=True
    )
    flow = torch.as_tensor(plan, device=cost.device)
    value = (flow * cost).sum()
    rows, columns = flow.nonzero(as_tuple=True)
    difference = source.points.double()[rows] - target.points.double()[columns]
    length = cost[rows, columns].clamp_min(1e-30) if problem.exponent == 1 else torch.full_like(cost[rows, columns], 0.5)
    gradient = torch.zeros_like(source.points, dtype=torch.float64)
    gradient.index_add_(0, rows, difference * (flow[rows, columns] / length)[:, None])
    shift = value.to(result.value) - result.value
    return dataclasses.replace(
        result,
        value=value.to(result.value),
        source_gradient=gradient.to(result.source_gradient),
        target_potential=result.target_potential + shift,
        converged=result.converged and log["warning"] is None,
    )
