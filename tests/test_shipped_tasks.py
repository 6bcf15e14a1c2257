"""Shipped tasks lead where they did: a few iterations of the default strategy, few particles, on the fastest simulator installed.

The figures were the same on two simulators to 0.2%; the tolerance leaves room for another processor.
"""

from __future__ import annotations

import pytest

from cpdeform import Status, deform, load_task

PARTICLES, ITERATIONS = 2000, 4
TOLERANCE = 0.03
"""Of the ratio of the losses after and before the first stage."""


@pytest.mark.slow
@pytest.mark.parametrize(("name", "ratio"), [("star", 0.681), ("pinch", 0.555), ("table-v1", 0.651)])
def test_the_first_stage_gains_what_it_did(name: str, ratio: float) -> None:
    bodies = len(load_task(name).scene.bodies)
    few = {str(body): {"particle_count": PARTICLES // bodies} for body in range(bodies)}
    settings = {"optimizer": {"iterations": ITERATIONS}, "scene": {"bodies": few}}
    (stage,) = deform(name, settings=settings, stages=1).stages
    assert stage.status is Status.FINISHED
    assert stage.loss / stage.loss_before == pytest.approx(ratio, abs=TOLERANCE)
