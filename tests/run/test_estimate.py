"""What a run will take: counted work, measured units, and the time left as stages and evaluations go by."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import pytest

from cpdeform.core.plugins import load_registry
from cpdeform.planning.effort import Effort, JointEffort
from cpdeform.planning.optimizer import TrajectoryOptimizer
from cpdeform.planning.pruner import PrunerHalving, PrunerNone
from cpdeform.run.estimate import FASTER, SLOWER, RunEstimate, UnitCost, largest_need, memory_bounds
from cpdeform.run.resolve import resolve
from cpdeform.run.time_left import TimeLeft, duration, duration_range

UNIT = UnitCost(gradient=2.0, rollout=0.5, transport=1.0)


class Clock:
    now = 100.0

    def __call__(self) -> float:
        return self.now


def made(*, stages: int = 2, gradients: tuple[int, int] = (10, 40), joint: tuple[JointEffort, ...] = (), **options) -> RunEstimate:
    effort = Effort(gradients=gradients, rollouts=(1, 1))
    return RunEstimate(stages=stages, effort=effort, joint=joint, memory=memory_bounds(1000, 100), unit=UNIT, **options)


@pytest.mark.parametrize("pruner", [PrunerNone(), PrunerHalving()])
def test_the_most_gradients_of_a_descent_are_those_that_a_descent_without_patience_computes(pruner) -> None:
    optimizer = TrajectoryOptimizer(iterations=12, patience=12, pruner=pruner)
    least, most = optimizer.effort(5).gradients
    assert most == {"none": 60, "halving": 5 * 5 + 2 + 6 * 1}[pruner.name]
    assert least == most
    assert dataclasses.replace(optimizer, patience=2).effort(5).gradients == (15, most)


def test_seconds_and_bytes_are_sums_of_what_was_measured() -> None:
    found = made()
    assert found.seconds == pytest.approx((2 * FASTER * (10 * 2.0 + 0.5 + 1.0), 2 * SLOWER * (40 * 2.0 + 0.5 + 1.0)))
    assert found.memory[0] == 1080
    assert found.memory[1] > 1120
    shared = made(workers=2)
    assert shared.seconds[0] == pytest.approx(2 * FASTER * (10.25 + 1.0))


def test_a_descent_over_stages_together_costs_a_gradient_of_each_an_iteration() -> None:
    joint = JointEffort(after=2, stages=2, iterations=(5, 30))
    found = made(joint=(joint,), workers=2)
    assert found.total.gradients == (2 * 10 + 2 * 5, 2 * 40 + 2 * 30)
    # It is one world, so that the processes that share a stage do not share it.
    assert found.seconds[1] - made(workers=2).seconds[1] == pytest.approx(SLOWER * 2 * (30 * 2.0 + 0.5))
    assert made(workers=2).seconds[0] < found.seconds[0]


def test_fewer_worlds_may_take_more_memory_and_stages_together_take_theirs() -> None:
    # Two worlds keep all substeps, three none, so that a batch that shrinks from three to two takes more than it did.
    needs = {1: 100, 2: 200, 3: 50}
    simulator = SimpleNamespace(memory_estimate=lambda steps, worlds: steps * needs[worlds])
    planner = SimpleNamespace(simulator=simulator, task=SimpleNamespace(rollout_steps=10))
    assert [largest_need(planner, worlds=worlds) for worlds in (1, 2, 3)] == [1000, 2000, 2000]
    assert largest_need(planner, worlds=3, joint=[JointEffort(after=4, stages=4, iterations=(1, 1))]) == 4000


def test_the_time_left_follows_what_happened() -> None:
    clock = Clock()
    expected = made(stages=3)
    left = TimeLeft(expected, stages=3, clock=clock)
    left.stage_started()
    assert left.seconds() == pytest.approx(3 * expected.stage_seconds)
    # Half of the stage's gradients at a tenth of the time that was expected for them.
    left.evaluated(round(0.5 * expected.stage_gradients))
    clock.now += 0.05 * expected.stage_seconds
    after_half = left.seconds()
    assert after_half is not None
    assert 2.0 * expected.stage_seconds < after_half < 2.95 * expected.stage_seconds
    # The stage takes 4 s: so will the others.
    clock.now = 104.0
    left.stage_finished()
    left.stage_started()
    assert left.seconds() == pytest.approx(8.0)
    clock.now = 106.0
    assert left.elapsed == pytest.approx(6.0)
    assert left.seconds() == pytest.approx(6.0)
    clock.now = 109.0
    assert left.seconds() == pytest.approx(4.0)  # longer than expected, but no less than the stage that is left
    left.stage_finished()
    clock.now = 110.0
    left.stage_finished()
    assert left.seconds() == 0.0


def test_the_time_left_knows_of_descents_to_come() -> None:
    clock = Clock()
    first, last = JointEffort(after=1, stages=1, iterations=(10, 10)), JointEffort(after=2, stages=2, iterations=(40, 40))
    expected = made(joint=(first, last))
    left = TimeLeft(expected, stages=2, clock=clock)
    left.stage_started()
    both = expected.joint_seconds(first) + expected.joint_seconds(last)
    assert left.seconds() == pytest.approx(2 * expected.stage_seconds + both)
    clock.now += 7.0
    left.stage_finished()
    assert left.seconds() == pytest.approx(7.0 + both)
    # The first takes twice what was expected, and so will the last.
    left.joint_started()
    left.evaluated(5)
    clock.now += expected.joint_seconds(first)
    halfway = left.seconds()
    left.evaluated(5)
    clock.now += expected.joint_seconds(first)
    left.joint_finished()
    left.stage_started()
    ahead = 2.0 * expected.joint_seconds(last)
    assert left.seconds() == pytest.approx(7.0 + ahead)
    assert halfway is not None
    assert halfway == pytest.approx(7.0 + expected.joint_seconds(last) + 0.5 * expected.joint_seconds(first))
    clock.now += 7.0
    left.stage_finished()
    assert left.seconds() == pytest.approx(ahead)
    left.joint_started()
    clock.now += 10.0
    assert left.seconds() == pytest.approx(ahead - 10.0)
    left.joint_finished()
    assert left.seconds() == 0.0


def test_a_descent_that_does_not_come_is_forgotten() -> None:
    expected = made(joint=(JointEffort(after=1, stages=1, iterations=(10, 10)),))
    clock = Clock()
    left = TimeLeft(expected, stages=2, clock=clock)
    left.stage_started()
    clock.now += 3.0
    left.stage_finished()
    left.stage_started()
    assert left.seconds() == pytest.approx(3.0)


def test_stages_whose_results_come_together_share_their_time() -> None:
    clock = Clock()
    left = TimeLeft(None, stages=4, clock=clock)
    assert left.seconds() is None
    left.stage_started()
    left.stage_started()
    clock.now += 10.0
    left.stage_finished()
    left.stage_finished()
    assert left.seconds() == pytest.approx(2 * 5.0)


def test_durations_are_read_easily() -> None:
    assert [duration(seconds) for seconds in (0.2, 45, 89, 100, 3600, 86400)] == [
        "1 s",
        "45 s",
        "89 s",
        "2 min",
        "60 min",
        "24 h 00 min",
    ]
    assert duration_range((40.0, 130.0)) == "40 s to 2 min"
    assert duration_range((100.0, 130.0)) == "2 min"


def test_a_run_does_not_compute_more_than_was_estimated(toy_entry_points, toy_task_file) -> None:
    toy_registry = load_registry(toy_entry_points)
    given = {"task": str(toy_task_file), "backend": "toy", "ot": "toy", "placer": "toy", "optimizer": {"iterations": 4}}
    resolved = resolve(given, registry=toy_registry)
    told = []
    result = resolved.run(on_estimate=told.append)
    assert told[0].stages == resolved.task.stage_count
    assert result.gradient_evaluations <= told[0].total.gradients[1]
    assert told[0].seconds[0] <= told[0].seconds[1]
    # Measuring changes nothing in the run.
    again = resolve(given, registry=toy_registry).run()
    assert again.loss_final == result.loss_final
