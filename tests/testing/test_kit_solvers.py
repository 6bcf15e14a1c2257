"""`check_ot_solver`: every registered solver passes, and each check catches one that is broken in its way."""

from __future__ import annotations

import dataclasses

import ot
import pytest
import torch
from kit import assert_caught

from cpdeform.core.ot import OTSolver, fix_gauge
from cpdeform.core.plugins import load_registry
from cpdeform.ot.geomloss import OTSolverGeomLoss
from cpdeform.ot.pot import OTSolverPOT
from cpdeform.testing import check_ot_solver
from cpdeform.testing.ot import OT_CHECKS


@pytest.mark.parametrize("name", load_registry().names("ot_solver"))
def test_registered_solvers_pass(name):
    report = check_ot_solver(load_registry().load("ot_solver", name))
    report.raise_if_failed()
    assert len(report.checks) == len(OT_CHECKS)
    assert not report.select("skipped")


def changed_result(change, *, solver=OTSolverGeomLoss, **options):
    """A solver whose results go through `change`."""

    class OTSolverBroken(solver):
        def __init__(self):
            super().__init__(**options)

        def solve(self, source, target, **arguments):
            return change(super().solve(source, target, **arguments))

    return OTSolverBroken


class OTSolverIgnoringWeights(OTSolverGeomLoss):
    def solve(self, source, target, *, source_weights=None, target_weights=None, previous=None):
        return super().solve(source, target, previous=previous)


class OTSolverExactDual(OTSolverGeomLoss):
    """Returns a vertex of the exact dual and calls it entropic."""

    def solve(self, source, target, *, source_weights=None, target_weights=None, previous=None):
        result = super().solve(source, target, source_weights=source_weights, target_weights=target_weights, previous=previous)
        counts = (len(source), len(target))
        a, b = (torch.full((count,), 1 / count, dtype=torch.float64) for count in counts)
        cost = torch.cdist(source.double(), target.double())
        _, log = ot.emd(a.numpy(), b.numpy(), cost.numpy(), log=True)
        f, g = fix_gauge(torch.as_tensor(log["u"]), torch.as_tensor(log["v"]), a)
        return dataclasses.replace(result, source_potential=f.to(source), target_potential=g.to(source))


class OTSolverStale(OTSolverGeomLoss):
    def solve(self, source, target, *, source_weights=None, target_weights=None, previous=None):
        moved = source if previous is None else source + 0.01
        return super().solve(moved, target, source_weights=source_weights, target_weights=target_weights)


class OTSolverForgiving(OTSolverGeomLoss):
    def solve(self, source, target, **arguments):
        return super().solve(source.nan_to_num(), target, **arguments)


class OTSolverBiased(OTSolverPOT):
    """Debiased by declaration only."""

    def __init__(self):
        super().__init__(blur=2e-2, debias=False)
        self.capabilities = OTSolverPOT.capabilities


BROKEN_SOLVERS = {
    "shapes and types of the result": changed_result(lambda result: dataclasses.replace(result, value=result.value.reshape(1))),
    "closed form of a translation": changed_result(lambda result: dataclasses.replace(result, value=1.1 * result.value)),
    "gauge: zero weighted median": changed_result(
        lambda result: dataclasses.replace(
            result, source_potential=result.source_potential + 0.01, target_potential=result.target_potential - 0.01
        )
    ),
    "potentials sum to the value": changed_result(
        lambda result: dataclasses.replace(result, target_potential=result.target_potential + 1e-4)
    ),
    "gradient equals central differences": changed_result(
        lambda result: dataclasses.replace(result, source_gradient=1.02 * result.source_gradient)
    ),
    "potentials are slopes by the weights": changed_result(
        lambda result: dataclasses.replace(result, source_potential=-result.source_potential)
    ),
    "weights and order of the points": OTSolverIgnoringWeights,
    "identical clouds": OTSolverBiased,
    "priorities point at a pen's stroke": OTSolverExactDual,
    "warm start": OTSolverStale,
    "bad arguments are named": OTSolverForgiving,
}


def test_every_check_of_solvers_has_a_broken_one():
    assert set(BROKEN_SOLVERS) == {item.name for item in OT_CHECKS}


@pytest.mark.parametrize("name", BROKEN_SOLVERS)
def test_broken_solvers_are_caught(name):
    assert_caught(check_ot_solver(BROKEN_SOLVERS[name], only=[name]), name)


def test_honest_declarations_skip_what_they_rule_out():
    class OTSolverHonest(OTSolverExactDual):
        capabilities = dataclasses.replace(OTSolverGeomLoss.capabilities, potentials="exact")

        def __init__(self):
            super().__init__()
            self.capabilities = type(self).capabilities

    (check,) = check_ot_solver(OTSolverHonest(), only=["stroke"]).checks
    assert check.status == "skipped"
    assert "no transport priorities" in check.advice


def test_a_solver_that_raises_is_a_failed_check():
    class OTSolverAbsent(OTSolver):
        def solve(self, source, target, *, source_weights=None, target_weights=None, previous=None):
            raise RuntimeError("no licence")

    report = check_ot_solver(OTSolverAbsent)
    assert_caught(report, "it solves")
    assert "no licence" in str(report)
