"""Figures of a run that is measured from rest, computed anew."""

from __future__ import annotations

from cpdeform.run.deform import deform
from cpdeform.run.record import load_record, save_result
from cpdeform.run.verify import verify_record

SMALL = {"touches": 2, "variations": 1, "polished": (1, 1), "iterations": (1, 1), "joint_gradients": 2, "together": 1}
"""Options of `sculpt` for a stage of a few seconds."""


def test_a_run_from_rest_holds(tmp_path):
    """Star's slab hangs above the floor, and its loss is measured from where it lies."""
    settings = {
        "strategy_options": SMALL,
        "scene": {"bodies": {"0": {"particle_count": 1000}}},
        "objective": {"points": 300},
    }
    result = deform("star", strategy="sculpt", settings=settings, stages=1, seed=3)
    record = load_record(save_result(result, tmp_path / "run", configuration=result.configuration))
    assert record.stages[0].loss_before > 1.9
    checks = list(verify_record(record))
    names = {check.name for check in checks}
    assert {"stage 1: loss before", "wasserstein at the end"} <= names
    assert [check for check in checks if not check.holds] == []
    # Without its configuration a record does not say what its losses measure.
    plain = load_record(save_result(result, tmp_path / "plain"))
    found = list(verify_record(plain))
    assert {check.name for check in found} == {name for name in names if not name.startswith("stage 1: loss")}
    assert all(check.holds for check in found)
