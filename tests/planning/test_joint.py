"""Joint polish of several stages, on the toy simulator with gradients that can be chained."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from cpdeform_toy.parts import OTSolverToy, PlacerToy
from cpdeform_toy.simulator import SimulatorToy

from cpdeform.cli.progress import ProgressLines
from cpdeform.core.objective import ObjectiveAutograd
from cpdeform.core.simulator import RolloutGradient
from cpdeform.core.task import load_task
from cpdeform.planning.algorithm import Planner
from cpdeform.planning.chain import SimulatorChain
from cpdeform.planning.joint import PHASE, polish_jointly
from cpdeform.planning.optimizer import TrajectoryOptimizer
from cpdeform.planning.phases.descent import PhaseDescent
from cpdeform.planning.pruner import PrunerNone
from cpdeform.planning.result import Observer, Status
from cpdeform.planning.strategies.sculpt import StrategySculpt, joint_optimizer
from cpdeform.run.deform import deform
from cpdeform.run.record import RunRecorder, load_record


class SimulatorChained(SimulatorToy):
    """The toy, its gain fixed, with a gradient that goes back to the start: what moves the start moves the end as far."""

    def gain(self, state):
        return torch.full((state.batch_size,), 0.5).to(state.position)

    def vjp(self, trajectory, grad_positions, grad_tools=None, *, grad_final_state=None) -> RolloutGradient:
        if grad_final_state is not None:
            grad_positions = grad_positions.clone()
            grad_positions[:, -1] += grad_final_state.position
        found = super().vjp(trajectory, grad_positions, grad_tools)
        start = dataclasses.replace(found.initial_state, position=grad_positions.sum(dim=1))
        return dataclasses.replace(found, initial_state=start)


class Bend(ObjectiveAutograd):
    """Distance of the centre of mass from a point that lies farther away than a stage can go."""

    def loss(self, positions, tool_poses):
        centre = positions[:, -1].mean(dim=1)
        return (centre - centre.new_tensor([2.0, 0.5, 0.5])).square().sum(dim=-1)


@pytest.fixture
def task(make_toy_task):
    return load_task(make_toy_task(stage_count=3, step_count=5))


def planner(task, **options):
    optimizer = TrajectoryOptimizer(iterations=2, pruner=PrunerNone())
    return Planner(
        task=task,
        simulator=SimulatorChained(task.scene, batch_size=4),
        ot_solver=OTSolverToy(),
        placer=PlacerToy(),
        objective=Bend(),
        phases=(PhaseDescent(optimizer=optimizer),),
        **options,
    )


OPTIMIZER = TrajectoryOptimizer(iterations=20, learning_rate=0.2, pruner=PrunerNone(), annealed=True)


def test_stages_are_polished_together_and_hang_together(task):
    parts = planner(task)
    before = parts.run(stages=3).stages
    after = polish_jointly(parts, before, OPTIMIZER)
    assert after[-1].loss < 0.99 * before[-1].loss
    state = before[0].state_before
    for old, new in zip(before, after, strict=True):
        assert torch.equal(new.state_before.position, state.position)
        replayed = parts.simulator.rollout(state.with_tools(new.tool_poses[0][None]), new.actions[None])
        assert torch.equal(replayed.final_state.position, new.state.position)
        assert new.loss == pytest.approx(float(parts.objective.evaluate(replayed).loss[0]))
        assert torch.equal(new.candidates[new.best].actions, new.actions)
        assert new.candidates[new.best].loss == new.loss
        # An iteration costs a gradient a stage; the execution is one more rollout.
        assert new.gradient_evaluations == old.gradient_evaluations + OPTIMIZER.iterations
        assert new.rollouts == old.rollouts + 1
        state = new.state
    assert [result.loss_before for result in after[1:]] == [result.loss for result in after[:-1]]
    assert {iteration.phase for iteration in after[-1].history[-OPTIMIZER.iterations :]} == {PHASE}


def test_stages_without_a_plan_take_the_state_of_the_one_before(task):
    parts = planner(task)
    found = list(parts.run(stages=2).stages)
    idle = dataclasses.replace(found[1], index=2, best=None, actions=None, status=Status.NO_IMPROVEMENT)
    after = polish_jointly(parts, [*found, idle], OPTIMIZER)
    assert after[1].loss < found[1].loss
    # What comes next begins where the polished stages end, not where they had ended before.
    assert after[2].state is after[2].state_before is after[1].state
    assert (after[2].loss, after[2].loss_before) == (after[1].loss, after[1].loss)
    assert (after[2].status, after[2].actions) == (Status.NO_IMPROVEMENT, None)
    assert polish_jointly(parts, [idle], OPTIMIZER) == [idle]


def test_a_polish_that_gains_nothing_changes_no_plan(task):
    parts = planner(task)
    before = parts.run(stages=2).stages
    after = polish_jointly(parts, before, dataclasses.replace(OPTIMIZER, iterations=1))
    for old, new in zip(before, after, strict=True):
        assert torch.equal(old.actions, new.actions)
        assert (old.loss, old.gradient_evaluations + 1) == (new.loss, new.gradient_evaluations)


class Toll(Bend):
    """The same, and a toll for the tools' way, summed over all steps."""

    def loss(self, positions, tool_poses):
        return super().loss(positions, tool_poses) + 0.5 * tool_poses.diff(dim=1)[..., 0, 0].abs().sum(dim=-1)


def test_what_the_whole_row_gains_counts(task):
    """Both stages' ways are paid for: the polish may raise the last stage's loss where it lowers that of the row."""
    parts = dataclasses.replace(planner(task), objective=Toll())
    before = parts.run(stages=2).stages
    after = polish_jointly(parts, before, OPTIMIZER)
    chain = SimulatorChain(parts.simulator, poses=torch.stack([stage.candidates[stage.best].proposal.pose for stage in before]))

    def whole(stages):
        plan = torch.cat([stage.actions for stage in stages])[None]
        return float(parts.objective.losses(chain.rollout(before[0].state_before, plan))[0])

    assert whole(after) < whole(before)
    losses = [float(iteration.best_loss[0]) for iteration in after[-1].history if iteration.phase == PHASE]
    assert whole(after) == pytest.approx(losses[-1])


class Interrupt(Observer):
    """Control-C in the second iteration of the joint polish."""

    def __init__(self):
        self.told, self.revised = [], []

    def iteration_finished(self, stage, iteration):
        if iteration.phase == PHASE and iteration.index == 1:
            raise KeyboardInterrupt

    def stage_finished(self, result):
        self.told.append(result)

    def stages_revised(self, revision):
        self.revised.append(revision)


def sculpted(task, *, simulator=SimulatorChained, changes=None, **options):
    numbers = {"touches": 8, "variations": 4, "iterations": (1, 1), "together": 2, "joint_gradients": 10, **(changes or {})}
    strategy = StrategySculpt(**numbers)
    parts = {"simulator": simulator(task.scene, batch_size=4), "ot_solver": OTSolverToy()}
    return deform(task, strategy=strategy, settings={"objective": {"points": None}}, **parts, seed=1, **options)


def test_the_strategy_polishes_two_stages_at_a_time(task):
    result = sculpted(task)
    phases = [{iteration.phase for iteration in stage.history} for stage in result.stages]
    assert [PHASE in found for found in phases] == [False, True, True]
    assert all(PHASE in stage.seconds for stage in result.stages)
    alone = sculpted(task, simulator=SimulatorToy)
    assert not any(PHASE in stage.seconds for stage in alone.stages)


def test_the_estimate_counts_the_gradients_that_joint_descents_compute(task):
    """Neither stages nor descents stop early here, so that what is told at most is what is computed."""
    changes = {"together": 3, "joint_every": 1, "joint_gradients": 15, "interim_gradients": 4}
    efforts = StrategySculpt(**changes).joint_efforts(SimulatorChained(task.scene), stages=3)
    found = [(effort.after, effort.stages, effort.iterations) for effort in efforts]
    assert found == [
        (1, 1, (4, 4)),
        (2, 2, (2, 2)),
        (3, 3, (5, 5)),
    ]
    result = sculpted(task, changes=changes)
    joint = sum(iteration.phase == PHASE for stage in result.stages for iteration in stage.history)
    assert joint == sum(effort.iterations[1] for effort in efforts)
    alone = sculpted(task, simulator=SimulatorToy, changes=changes)
    counted = sum(effort.effort.gradients[1] for effort in efforts)
    assert result.gradient_evaluations == alone.gradient_evaluations + counted
    assert StrategySculpt(**changes).joint_efforts(SimulatorToy(task.scene), stages=3) == ()


def test_the_longer_a_row_the_smaller_its_steps():
    rates = [joint_optimizer(stages=stages, gradients=180).learning_rate for stages in (1, 4, 6, 12)]
    assert rates == pytest.approx([0.06, 0.06, 0.04, 0.02])


def test_rows_of_any_length_have_the_same_gradients_but_short_ones_an_end():
    counts = [joint_optimizer(stages=stages, gradients=960).iterations for stages in (1, 3, 6, 9, 12, 16, 1000)]
    assert counts == [480, 160, 80, 80, 80, 60, 1]


def test_patience_does_not_end_a_joint_descent_before_its_small_steps(task):
    """The toy's clay is where it should be long before: patience ended the descent there."""
    result = sculpted(task, changes={"together": 1, "joint_gradients": 60})
    counts = [
        sum(iteration.phase == PHASE for iteration in stage.history) for stage in result.stages if stage.status is Status.FINISHED
    ]
    assert counts == [60, 60]


def test_stages_are_polished_on_the_way_and_once_more_at_the_end(task):
    """All three together at the end; the first two on their way, and the third one goes on from where these then end."""
    result = sculpted(task, changes={"together": 3, "joint_every": 2, "joint_gradients": 15, "interim_gradients": 4})
    counts = [sum(iteration.phase == PHASE for iteration in stage.history) for stage in result.stages]
    assert counts == [0, 2, 5]
    first, second, third = result.stages
    assert torch.equal(second.state.position, third.state_before.position)
    assert torch.equal(first.state.position, second.state_before.position)
    assert {stage.status for stage in result.stages} == {Status.FINISHED}


def test_an_interruption_keeps_the_best_plans_so_far(task):
    watch = Interrupt()
    with pytest.raises(KeyboardInterrupt):
        sculpted(task, observers=(watch,))
    assert [result.index for result in watch.told] == [0, 1]
    (revision,) = watch.revised
    assert [result.index for result in revision.results] == [0, 1]
    assert all(result.status is Status.FINISHED for result in revision.results)
    # What was computed until then counts, and its gain is executed.
    last = revision.results[-1]
    tried = [iteration for iteration in last.history if iteration.phase == PHASE]
    assert len(tried) == 2
    assert last.loss <= float(tried[0].loss[0])


def test_progress_tells_of_revisions(task, capsys):
    lines = ProgressLines()
    result = sculpted(task, observers=(lines,))
    first, second = (result.stages[index] for index in (0, 1))
    text = f"stages 1 to 2: joint polish, loss {first.loss_before:.4g} -> {second.loss:.4g}"
    assert text in capsys.readouterr().err


def test_a_record_holds_the_revised_stages(task, tmp_path):
    """As the result does; and a copy of the record taken before the polish has the stages as they were found."""
    recorder = RunRecorder(tmp_path / "run")
    early = []

    class Copy(Observer):
        def part_started(self, stage, part):
            if part == PHASE and not early:
                early.append(load_record(tmp_path / "run").stages)

    with recorder:
        result = sculpted(task, observers=(recorder, Copy()))
    record = load_record(tmp_path / "run")
    for stage, kept in zip(result.stages, record.stages, strict=True):
        assert torch.equal(kept.actions, stage.actions)
        assert torch.equal(kept.state.position, stage.state.position)
        assert (kept.loss, kept.loss_before) == (stage.loss, stage.loss_before)
        assert kept.gradient_evaluations == stage.gradient_evaluations
    assert [stage.index for stage in early[0]] == [0, 1]
    assert record.stages[1].loss < early[0][1].loss
    revisions = [line for line in record.metrics if line["kind"] == "revision"]
    assert [(line["stage"], line["stages"]) for line in revisions] == [(1, 2), (2, 1)]
    assert revisions[0]["loss"] == record.stages[1].loss
    assert record.run["stages_finished"] == 3


def test_memory_of_the_chain_is_given_back_by_its_simulator(task):
    class Keeping(SimulatorChained):
        released = 0

        def release_memory(self):
            self.released += 1

    simulator = Keeping(task.scene)
    SimulatorChain(simulator, poses=simulator.initial_state().tool_pose).release_memory()
    assert simulator.released == 1
