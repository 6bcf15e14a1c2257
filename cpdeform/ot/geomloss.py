"""Optimal transport with GeomLoss: its annealed start and its `paper` settings, iterated on to convergence."""

from __future__ import annotations

import dataclasses
from typing import ClassVar, Literal

import torch
from geomloss import SamplesLoss
from torch import Tensor

from cpdeform.core.errors import InputError
from cpdeform.core.forking import prepare_for_forks
from cpdeform.core.options import real_number
from cpdeform.core.ot import OTCapabilities, OTResult, OTSolver, fix_gauge
from cpdeform.ot.annealing import Schedule, solve_cold
from cpdeform.ot.divergence import Potentials, Problem, check_choice, check_options, finish, usable_state, warm_potentials
from cpdeform.ot.schedule import geomloss_blurs, geomloss_potentials
from cpdeform.ot.softmin import pair_cost
from cpdeform.ot.sparse import descend

_PAPER_DENSE = 2000**2  # pairs up to which GeomLoss itself computes the paper's settings, with a dozen matrices of that size
_START = 0.05  # blur, as a fraction of the diameter, down to which GeomLoss's own schedule is followed


class OTSolverGeomLoss(OTSolver):
    """Sinkhorn divergence of GeomLoss [2]_, for the cost c(x, y) = |x - y|^p and the temperature eps = blur^p.

    The entropic problem [1]_

        OT(a, b) = min_P <P, c> + eps KL(P | a (x) b) = max_(f, g) <a, f> + <b, g>  at the fixed point                  (1)

    is debiased to S(a, b) = OT(a, b) - OT(a, a)/2 - OT(b, b)/2, with potentials f_xy - f_xx and g_xy - g_yy.

    GeomLoss's schedule makes one averaged update per temperature and is not converged for p = 1 and small blurs: 78-86% of
    the transport cost at blur 1e-3, and a gradient whose cosine with the true one is 0.60-0.65. With ``settings="converged"``,
    `geomloss.SamplesLoss` therefore solves the wide blurs, on at most 2000 points, and what follows is ours, since GeomLoss's
    public interface offers neither a warm start nor a stopping criterion: the descent to the final blur on all points with
    sparse kernels [3]_, and warm starts. ``settings="paper"`` is `SamplesLoss` alone, exactly as the paper used it; above 2000
    points the same schedule is computed in row chunks, without the matrices (`cpdeform.ot.schedule`).

    Args:
        blur: Entropic blur, length units. Smaller is sharper and slower.
        exponent: Power p of the distance, 1 or 2.
        debias: Whether to subtract the self-terms.
        settings: ``"converged"``, or ``"paper"`` to reproduce the paper's figures: GeomLoss's tensorized backend with its
            distances (floored at 1e-4). Give it double precision: in single precision GeomLoss's distances are off by 3e-4.
        scaling: Ratio of successive blurs; 0.5 is GeomLoss's default and the paper's value.
        tolerance: L1 error of the source marginal at which a solution counts as converged.
        iterations: Most iterations at one temperature.
        warm_iterations: Iterations of a warm call; more follow the moving cloud more closely.

    Note:
        A blur far below the point spacing leaves the potentials of points that touch only their own copies nearly free. The
        marginals do not see them: every temperature gets 100 iterations at least, and a `scaling` nearer 1 helps. That, not
        the marginals, sets `potential_tolerance`: 0.05 measured on a pen stroke, 0.002 between unrelated clouds.

    Raises:
        InputError: An option is out of range.

    References:
        .. [1] Cuturi, "Sinkhorn Distances: Lightspeed Computation of Optimal Transport", NeurIPS 2013.
        .. [2] Feydy et al., "Interpolating between Optimal Transport and MMD using Sinkhorn Divergences", AISTATS 2019.
        .. [3] Peyré & Cuturi, "Computational Optimal Transport", Foundations and Trends in Machine Learning, 2019.
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
        settings: Literal["converged", "paper"] = "converged",
        scaling: float = 0.5,
        tolerance: float = 1e-3,
        iterations: int = 3000,
        warm_iterations: int = 1,
    ) -> None:
        prepare_for_forks()
        check_options(blur=blur, exponent=exponent, tolerance=tolerance, iterations=iterations, warm_iterations=warm_iterations)
        check_choice("settings", settings, ("converged", "paper"))
        real_number("scaling", scaling, least=1e-3, most=0.99, expected="a number between 0 and 1")
        if settings == "paper" and exponent != 1:
            raise InputError("exponent", came=f"{exponent}", expected='1 with settings="paper", as in the paper')
        self.blur = float(blur)
        self.exponent = exponent
        self.debias = debias
        self.settings = settings
        self.scaling = scaling
        self.tolerance = tolerance
        self.iterations = iterations
        self.warm_iterations = warm_iterations
        paper = settings == "paper"
        self.capabilities = dataclasses.replace(  # type: ignore[misc]  # what this instance does, within what the class declares
            type(self).capabilities,
            debiased=debias,
            warm_start=not paper,
            potential_tolerance=1.0 if paper else type(self).capabilities.potential_tolerance,
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

        With `previous`, a call makes `warm_iterations` Sinkhorn iterations, the source potential first: it is the one whose
        points moved, and the target's potential, a function on unmoved points, predicts it. Errors accumulate slowly over many
        calls, so start cold again from time to time.
        """
        with torch.no_grad():
            problem = Problem.of(source, target, source_weights, target_weights, self.blur, self.exponent)
            if self.settings == "paper":
                return self._paper(problem)
            state = usable_state(previous, problem, self.blur, debias=self.debias)
            if state is None:
                schedule = Schedule(_START, self.scaling, self.tolerance, self.iterations)
                potentials, count = solve_cold(problem, schedule, self._start, _descent)
                if not self.debias:
                    potentials = dataclasses.replace(potentials, source_self=None, target_self=None)
            else:
                count = self.warm_iterations
                potentials = warm_potentials(problem, state, count)
                f, g = potentials.source, potentials.target
                for _ in range(count):
                    f = problem.source_update(g)
                    g = problem.target_update(f)
                potentials = dataclasses.replace(potentials, source=f, target=g)
            return finish(problem, potentials, blur=self.blur, tolerance=self.tolerance, iterations=count)

    def _start(self, problem: Problem) -> tuple[Tensor, Tensor]:
        """GeomLoss's annealed, debiased potentials at the temperature of `problem`."""
        exponent, blur = self.exponent, problem.epsilon ** (1 / self.exponent)
        loss = SamplesLoss(
            loss="sinkhorn",
            p=exponent,
            blur=blur,
            diameter=_given_diameter(problem, blur),
            scaling=self.scaling,
            debias=True,
            potentials=True,
            backend="tensorized",
            cost=lambda x, y: pair_cost(x, y, exponent),  # ours: GeomLoss's loses digits and floors at 1e-4
        )
        source, target = problem.source, problem.target
        with torch.no_grad():  # GeomLoss leaves gradients switched on behind it; this switches them off again
            first, second = loss(source.weights, source.points, target.weights, target.points)
        return first.detach().view(-1), second.detach().view(-1)  # it adds a batch axis

    def _paper(self, problem: Problem) -> OTResult:
        """The paper's loss: GeomLoss's schedule, its gradient that of the last update."""
        source, target = problem.source, problem.target
        if len(source.points) * len(target.points) <= _PAPER_DENSE:
            f, g, gradient = self._samples_loss(problem)
        else:
            f, g, gradient = geomloss_potentials(problem, blur=self.blur, scaling=self.scaling, debias=self.debias)
            gradient = source.weights[:, None] * gradient
        source_potential, target_potential = fix_gauge(f, g, source.weights)
        return OTResult(
            value=(source.weights * f).sum() + (target.weights * g).sum(),
            source_potential=source_potential,
            target_potential=target_potential,
            source_gradient=gradient,
            converged=False,
            iterations=len(geomloss_blurs(problem.diameter(), self.blur, self.scaling)),
            marginal_error=float("nan"),
            blur=self.blur,
            warm_state=Potentials(f, g, None, None, target),
        )

    def _samples_loss(self, problem: Problem) -> tuple[Tensor, Tensor, Tensor]:
        """Potentials (N,), (M,) of GeomLoss alone, and the gradient (N, 3) of its value by automatic differentiation."""
        source, target = problem.source, problem.target
        loss = SamplesLoss(
            loss="sinkhorn",
            p=1,
            blur=self.blur,
            diameter=_given_diameter(problem, self.blur),
            scaling=self.scaling,
            debias=self.debias,
            potentials=True,
            backend="tensorized",
        )
        with torch.enable_grad():
            points = source.points.clone().requires_grad_(True)
            f, g = (potential.view(-1) for potential in loss(source.weights, points, target.weights, target.points))
            value = (source.weights * f).sum() + (target.weights * g).sum()
            (gradient,) = torch.autograd.grad(value, points)
        return f.detach(), g.detach(), gradient


def _given_diameter(problem: Problem, blur: float) -> float | None:
    """What GeomLoss is to take as the diameter of points that are all one, of whose zero it takes the logarithm; else its own."""
    return None if problem.diameter() > 0.0 else blur


def _descent(problem: Problem, f: Tensor, g: Tensor, tolerance: float, limit: int) -> tuple[Tensor, Tensor, int]:
    return descend(problem, f, g, tolerance=tolerance, limit=limit)
