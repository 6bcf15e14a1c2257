"""Runs by touches that break off anywhere and go on equal those that went through, joint descents included."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from cpdeform_toy.parts import OTSolverToy, PlacerToy
from cpdeform_toy.simulator import SimulatorToy
from toy_fixtures import write_toy_task

from cpdeform.core.objective import ObjectiveAutograd
from cpdeform.core.plugins import load_registry
from cpdeform.core.task import load_task
from cpdeform.planning.algorithm import Planner, Start
from cpdeform.planning.joint import PHASE
from cpdeform.planning.optimizer import TrajectoryOptimizer
from cpdeform.planning.phases.descent import PhaseDescent
from cpdeform.planning.pruner import PrunerNone
from cpdeform.planning.result import Observer
from cpdeform.planning.taken_up import taken_up
from cpdeform.run import record as record_module
from cpdeform.run.record import RunRecorder, load_record
from cpdeform.run.record_continued import RunContinuer, broken_off
from cpdeform.run.record_files import unrevised_files
from cpdeform.run.resolve import PartObjects, resolve
from cpdeform.run.resume import resumed_values

NUMBERS = {"touches": 2, "variations": 1, "polished": [2, 1], "iterations": [1, 1], "coarse": False}
JOINT = {"together": 4, "joint_every": 2, "joint_gradients": 12, "interim_gradients": 4}
STAGES = 6


class SimulatorChained(SimulatorToy):
    """The toy with a gradient that goes back to the start: what moves the start moves the end as far."""

    def vjp(self, trajectory, grad_positions, grad_tools=None, *, grad_final_state=None):
        if grad_final_state is not None:
            grad_positions = grad_positions.clone()
            grad_positions[:, -1] += grad_final_state.position
        found = super().vjp(trajectory, grad_positions, grad_tools)
        return dataclasses.replace(
            found, initial_state=dataclasses.replace(found.initial_state, position=grad_positions.sum(dim=1))
        )


class Break(Observer):
    """Raises at the event with a certain number, counted over everything that a run tells."""

    def __init__(self, event=None, error=RuntimeError):
        self.event, self.error, self.count, self.log = event, error, 0, []

    def note(self, what):
        self.log.append(what)
        self.count += 1
        if self.event is not None and self.count > self.event:
            self.event = None
            raise self.error("broken off")

    def part_started(self, stage, part):
        self.note((stage, part))

    def iteration_finished(self, stage, iteration):
        self.note((stage, iteration.phase))

    def stage_finished(self, result):
        self.note((result.index, "finished"))

    def stages_revised(self, revision):
        self.note((revision.results[-1].index, "revised"))


@pytest.fixture(scope="module")
def registry():
    return load_registry()


@pytest.fixture(scope="module")
def run(registry, tmp_path_factory):
    """Runs the toy task into a directory of this module, or goes on with what is there."""
    tmp_path = tmp_path_factory.mktemp("continued")
    task = load_task(write_toy_task(tmp_path, stage_count=STAGES, step_count=5, offset=0.3))
    objects = PartObjects(simulator=SimulatorChained(task.scene, batch_size=4), ot_solver=OTSolverToy())
    values = {"strategy": "sculpt", "strategy_options": {**NUMBERS, **JOINT}, "seed": 2, "objective": {"points": None}}

    def start(name, *observers):
        resolved = resolve(values, registry=registry, task=task, objects=objects)
        with RunRecorder(tmp_path / name, configuration=resolved.configuration, overwrite=True) as recorder:
            resolved.run([recorder, *observers])
        return tmp_path / name

    def go_on(directory, *observers):
        earlier = broken_off(directory)
        if earlier is None:
            return start(directory.name, *observers)
        with RunContinuer(earlier) as recorder:
            resolve({}, registry=registry, record=earlier, objects=objects).run([recorder, *observers])
        return directory

    return start, go_on


@pytest.fixture(scope="module")
def whole(run):
    """The run that nothing disturbs, and what it tells."""
    start, _ = run
    watch = Break()
    return load_record(start("whole", watch)), watch.log


def assert_same(directory, whole):
    record = load_record(directory)
    assert record.status == whole.status
    assert len(record.stages) == len(whole.stages)
    for stage, expected in zip(record.stages, whole.stages, strict=True):
        assert stage.status is expected.status
        for field in dataclasses.fields(stage.state):
            assert torch.equal(getattr(stage.state, field.name), getattr(expected.state, field.name))
        assert (stage.loss, stage.loss_before) == (expected.loss, expected.loss_before)
        assert (stage.gradient_evaluations, stage.rollouts) == (expected.gradient_evaluations, expected.rollouts)
        assert set(stage.seconds) == set(expected.seconds)
    names = ("stages_finished", "loss_initial", "loss_final", "metric_value", "gradient_evaluations", "rollouts")
    assert {name: record.run[name] for name in names} == {name: whole.run[name] for name in names}
    plain = [[{**line, "seconds": None, "time": None} for line in found.metrics] for found in (record, whole)]
    assert plain[0] == plain[1]
    assert not unrevised_files(directory)


def test_the_run_has_joint_descents_on_the_way_and_at_each_end(whole):
    record, log = whole
    assert [entry[0] for entry in log if entry[1] == "revised"] == [1, 3, 5]
    assert record.stages[0].gradient_evaluations == 3 + 4 // 2 + 12 // 4


@pytest.mark.parametrize(("error", "first"), [(RuntimeError, 0), (KeyboardInterrupt, 1)])
def test_a_run_that_breaks_off_anywhere_goes_on_as_if_it_had_not(run, whole, error, first):
    """Killed or interrupted in descents over two, four and two stages, when these are recorded, and in and between stages."""
    start, go_on = run
    record, log = whole
    joint = [number for number, (_, what) in enumerate(log) if what == PHASE]
    between = range(7 + 25 * first, len(log), 50)
    events = {*joint[1 + first :: 4], *(number for number, (_, what) in enumerate(log) if what == "revised"), *between}
    assert {log[number] for number in events} >= {(last, what) for last in (1, 3, 5) for what in (PHASE, "revised")}
    for event in sorted(events):
        with pytest.raises(error):
            start("broken", Break(event, error))
        assert_same(go_on(load_record(directory_of(record, "broken")).directory), record)


def directory_of(record, name):
    return record.directory.with_name(name)


def test_a_run_may_break_off_again_and_again(run, whole):
    start, go_on = run
    record, log = whole
    directory, step = directory_of(record, "often"), len(log) // 3
    with pytest.raises(RuntimeError):
        start("often", Break(step))
    for _ in range(6):
        try:
            go_on(directory, Break(step))
            break
        except RuntimeError:
            continue
    assert_same(directory, record)


def test_a_revision_that_is_half_written_is_undone(run, whole, monkeypatch):
    """The run is killed while the files of the revised stages are written, the last one first."""
    start, go_on = run
    record, _ = whole
    plain, written = record_module.write_stage, []

    def write_stage(path, result):
        written.append(result.index)
        if written[-4:] == [3, 3, 2, 1]:
            raise RuntimeError("killed")
        plain(path, result)

    monkeypatch.setattr(record_module, "write_stage", write_stage)
    with pytest.raises(RuntimeError, match="killed"):
        start("torn")
    monkeypatch.setattr(record_module, "write_stage", plain)
    directory = directory_of(record, "torn")
    assert set(unrevised_files(directory)) == {0, 1, 2, 3}
    assert_same(go_on(directory), record)


def test_with_other_settings_the_stages_before_are_left_alone(run, whole, registry):
    """A run that goes on with another seed or other options polishes its own stages alone."""
    record, _ = whole
    short = dataclasses.replace(record, stages=record.stages[:2])
    objects = PartObjects(simulator=SimulatorChained(record.task.scene, batch_size=4), ot_solver=OTSolverToy())
    for changes, expected in (
        ({}, list(range(6))),
        ({"seed": 5}, [2, 3, 4, 5]),
        ({"strategy_options": {"touches": 7}}, [2, 3, 4, 5]),
    ):
        resolved = resolve(changes, registry=registry, record=short, objects=objects)
        assert resolved.continued is (not changes)
        assert [stage.index for stage in resolved.run().stages] == expected


def test_the_estimate_counts_the_stages_before(run, whole, registry):
    """Descents after the fourth and sixth stage, the first one over all four."""
    record, _ = whole
    simulator = SimulatorChained(record.task.scene, batch_size=4)
    objects = PartObjects(simulator=simulator, ot_solver=OTSolverToy())
    short = dataclasses.replace(record, stages=record.stages[:2])
    resolved = resolve({}, registry=registry, record=short, objects=objects)
    efforts = resolved.joint_efforts(simulator, stages=4)
    assert [(effort.after, effort.stages, effort.iterations) for effort in efforts] == [(2, 4, (3, 3)), (4, 2, (6, 6))]


def test_stages_are_taken_up_with_the_type_of_the_simulator(whole):
    """As new stages have it: the actions of all of them become one plan."""
    record, _ = whole
    single = [
        dataclasses.replace(stage, actions=stage.actions.float(), state=stage.state.to(dtype=torch.float32))
        for stage in record.stages
    ]
    simulator = SimulatorChained(record.task.scene, batch_size=4)
    planner = Planner(
        task=record.task, simulator=simulator, ot_solver=OTSolverToy(), placer=PlacerToy(), objective=Remembering(), phases=[]
    )
    start = Start(state=record.state, goal=record.goal, first_stage=6, stages=1, previous=tuple(single), continued=True)
    stages = taken_up(planner, start)
    assert {stage.actions.dtype for stage in stages} == {stage.state.position.dtype for stage in stages} == {simulator.dtype}
    assert [stage.warm for stage in stages] == [None] * 5 + [(1,)]
    assert taken_up(planner, dataclasses.replace(start, continued=False)) == []


def test_stages_without_a_plan_count_as_done(whole):
    """What is left of the planned stages counts from the next one's number."""
    record, _ = whole
    assert resumed_values(dataclasses.replace(record, stages=record.stages[:2]), {})["stages"] == STAGES - 2
    assert resumed_values(record, {})["stages"] == 1


class Remembering(ObjectiveAutograd):
    """Distance of the centre of mass from a point; what it starts from changes its gradient, as that of a solver does."""

    def loss(self, positions, tool_poses):
        centre = positions[:, -1].mean(dim=1)
        return (centre - centre.new_tensor([2.0, 0.5, 0.5])).square().sum(dim=-1)

    def evaluate(self, trajectory, warm=None):
        found = super().evaluate(trajectory)
        steps = [0 if entry is None else entry for entry in (warm or [None] * len(found.loss))]
        turned = found.grad_positions.roll(1, dims=-1) * found.loss.new_tensor(steps)[:, None, None, None]
        return dataclasses.replace(
            found, grad_positions=found.grad_positions + 0.1 * turned, warm=tuple(step + 1 for step in steps)
        )


@pytest.mark.parametrize("continued", [True, False])
def test_a_run_that_goes_on_starts_its_objective_as_the_stage_before_would_have(make_toy_task, continued):
    task = load_task(make_toy_task(stage_count=2, step_count=5))
    planner = Planner(
        task=task,
        simulator=SimulatorToy(task.scene, batch_size=4),
        ot_solver=OTSolverToy(),
        placer=PlacerToy(),
        objective=Remembering(),
        phases=[PhaseDescent(optimizer=TrajectoryOptimizer(iterations=3, pruner=PrunerNone()))],
    )
    whole = planner.run(stages=2).stages
    first = planner.run(stages=1).stages
    rest = planner.run(stages=1, state=first[0].state, first_stage=1, previous=first, continued=continued).stages
    assert torch.equal(first[0].state.position, whole[0].state.position)
    assert torch.equal(rest[0].state.position, whole[1].state.position) is continued
