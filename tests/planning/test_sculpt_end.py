"""When a run of touches ends: stages without a gain, and joint descents that bring one all the same."""

from __future__ import annotations

import dataclasses

import pytest
from cpdeform_toy.parts import OTSolverToy
from cpdeform_toy.simulator import SimulatorToy

from cpdeform.core.task import load_task
from cpdeform.planning.algorithm import Planner
from cpdeform.planning.result import Revision, Status
from cpdeform.planning.strategies import sculpt
from cpdeform.planning.strategies.sculpt import StrategySculpt
from cpdeform.run.deform import deform


@pytest.fixture
def follow(make_toy_task, monkeypatch):
    """Runs whose stages have given statuses and whose joint descents take given shares off the loss, and then nothing."""
    task = load_task(make_toy_task(stage_count=9, step_count=5))

    def run(statuses, shares, **options):
        left, taken = iter(statuses), iter(shares)
        plain = Planner.stage

        def stage(self, start, index, state, before, *, warm=None):
            return dataclasses.replace(plain(self, start, index, state, before, warm=warm), status=next(left))

        def polished(self, planner, held, iterations):
            loss = (1.0 - next(taken, 0.0)) * held[-1].loss
            yield Revision((*held[:-1], dataclasses.replace(held[-1], loss=loss)), sculpt.JOINT_POLISH)

        monkeypatch.setattr(Planner, "stage", stage)
        monkeypatch.setattr(StrategySculpt, "_polished", polished)
        strategy = StrategySculpt(touches=2, variations=1, iterations=(1, 1), **options)
        parts = {"simulator": SimulatorToy(task.scene, batch_size=4), "ot_solver": OTSolverToy()}
        result = deform(task, strategy=strategy, settings={"objective": {"points": None}}, **parts)
        monkeypatch.setattr(Planner, "stage", plain)
        return [found.index for found in result.stages]

    return run


IDLE, GAIN, BROKEN = Status.NO_IMPROVEMENT, Status.FINISHED, Status.NON_FINITE


def test_stages_without_a_gain_end_a_run(follow):
    assert follow([GAIN, IDLE, IDLE, IDLE], [0.1, 0.01], together=9, joint_every=3) == [0, 1, 2, 3]


def test_a_joint_descent_that_gains_lets_it_go_on(follow):
    """The three idle stages before it count no more; the next three do."""
    statuses = [GAIN, IDLE, IDLE, IDLE, GAIN, IDLE, IDLE, IDLE]
    # After stages 3 and 4 (three idle ones, gain), 6 and 8 (three idle ones again, no gain).
    assert follow(statuses, [0.1, 0.05, 0.01, 0.01, 0.01], together=9, joint_every=3) == list(range(8))


def test_all_stages_are_done_where_descents_gain(follow):
    assert follow([IDLE] * 9, [0.1] * 12, together=9, joint_every=3) == list(range(9))


def test_a_stage_that_broke_ends_the_run_whatever_a_descent_gains(follow):
    assert follow([GAIN, BROKEN], [0.5], together=9, joint_every=3)[-1] == 1
