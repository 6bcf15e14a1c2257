"""The strategy sculpt on the toy simulator, and its phase of polishing."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from cpdeform_toy.parts import OTSolverToy
from cpdeform_toy.simulator import SimulatorToy

from cpdeform.core.errors import InputError
from cpdeform.core.placer import Candidate, Proposal
from cpdeform.core.task import load_task
from cpdeform.planning.optimizer import TrajectoryOptimizer
from cpdeform.planning.phases.choice import MOST_ALIKE
from cpdeform.planning.phases.polish import PhasePolish
from cpdeform.planning.phases.screening import PhaseScreening
from cpdeform.planning.result import Status
from cpdeform.planning.strategies.sculpt import StrategySculpt
from cpdeform.run.deform import deform


@pytest.fixture
def task(make_toy_task):
    return load_task(make_toy_task(stage_count=3, step_count=5))


def candidates(losses, labels=None):
    pose = torch.zeros(1, 8)
    labels = labels or [f"way-{number}" for number in range(len(losses))]
    proposals = [Proposal(pose, 0.0, label, 7) for label in labels]
    return [Candidate(proposal, loss, torch.zeros(5, 3)) for proposal, loss in zip(proposals, losses, strict=True)]


class Bench:
    """Halves the loss of what it is given, or leaves it a little worse."""

    def __init__(self, factor):
        self.factor, self.asked, self.racing = factor, [], self

    def minimize(self, chosen, optimizer, objective, *, phase, placing):
        assert placing is None
        self.chosen = chosen
        self.asked = [candidate.loss for candidate in chosen]
        loss = torch.tensor([self.factor * candidate.loss for candidate in chosen], dtype=torch.float64)
        return dataclasses.make_dataclass("Found", ["loss", "actions"])(loss, torch.ones(len(chosen), 5, 3))

    def plan(self, place, actions):
        return dataclasses.replace(self.chosen[place], actions=actions)


def test_the_best_are_polished_and_none_gets_worse():
    polish = PhasePolish(keep=2, optimizer=TrajectoryOptimizer(iterations=1))
    before = candidates([3.0, 1.0, float("inf"), 2.0, float("nan")])
    bench = Bench(0.5)
    after = polish.run(bench, before)
    assert bench.asked == [1.0, 2.0]
    assert [candidate.loss for candidate in after[:4]] == [3.0, 0.5, float("inf"), 1.0]
    assert bool(after[1].actions.all())
    assert not after[0].actions.any()
    worse = polish.run(Bench(1.1), before)
    assert all(first is second for first, second in zip(worse, before, strict=True))


def test_variations_of_one_touch_do_not_take_all_places():
    polish = PhasePolish(keep=3, optimizer=TrajectoryOptimizer(iterations=1))
    bench = Bench(0.5)
    polish.run(bench, candidates([1.0, 2.0, 3.0, 4.0], ["push", "push", "push", "drag"]))
    assert MOST_ALIKE == 2
    assert bench.asked == [1.0, 2.0, 4.0]
    each = PhasePolish(keep=4, optimizer=TrajectoryOptimizer(iterations=1), each_kind=True)
    bench = Bench(0.5)
    each.run(bench, candidates([1.0, 2.0, 3.0, 4.0, torch.inf], ["push", "push", "push", "drag", "press"]))
    assert bench.asked == [1.0, 4.0, 2.0, 3.0]
    # What screening left out, and what broke, is not polished even where there is room.
    for kinds in (False, True):
        bench = Bench(0.5)
        dataclasses.replace(each, keep=9, each_kind=kinds).run(bench, candidates([torch.inf, 2.0, torch.nan, 1.0, -torch.inf]))
        assert bench.asked == [1.0, 2.0]
    with pytest.raises(InputError, match="keep: got 0"):
        PhasePolish(keep=0, optimizer=TrajectoryOptimizer())


def test_a_run_by_touches(task):
    """The toy's tool carries the body along wherever it is, so that any touch to the right gains."""
    options = {"simulator": SimulatorToy(task.scene, batch_size=4), "ot_solver": OTSolverToy()}
    strategy = StrategySculpt(touches=12, variations=6, iterations=(2, 2))
    settings = {"objective": {"points": None}}
    result = deform(task, strategy=strategy, settings=settings, **options, seed=1)
    first = result.stages[0]
    assert first.status is Status.FINISHED
    assert result.loss_final < 0.6 * result.loss_initial
    # Every candidate by a rollout, ten and then two of them by gradients, the clay left alone, and the execution.
    assert first.rollouts == len(first.candidates) + 2
    assert first.gradient_evaluations <= 10 * 2 + 2 * 2
    assert {iteration.phase for iteration in first.history} == {"polish"}
    assert {"touch"} == {result.configuration.placer}
    again = deform(task, strategy=strategy, settings=settings, **options, seed=1)
    assert again.loss_final == result.loss_final


def test_iterations_that_have_no_effect_are_told(task):
    parts = {"simulator": SimulatorToy(task.scene, batch_size=4), "ot_solver": OTSolverToy()}
    small = StrategySculpt(touches=2, variations=2, iterations=(1, 1))
    with pytest.warns(UserWarning, match="--iterations: no effect, since the strategy StrategySculpt"):
        deform(task, strategy=small, stages=1, settings={"optimizer": {"iterations": 3}, "objective": {"points": None}}, **parts)


def test_settings_and_options():
    strategy = StrategySculpt(touches=10)
    found = strategy.settings(load_task("star"), placer=None)
    assert (found["placer"], found["placer_options"]["count"], found["objective"]["kind"]) == ("touch", 10, "shape")
    assert "placer_options" not in strategy.settings(load_task("star"), placer="fixed")
    with pytest.raises(InputError, match="idle: got 0"):
        StrategySculpt(idle=0)
    assert PhaseScreening(keep=3).scope == "round"
