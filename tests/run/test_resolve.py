"""The one resolver: what the user gives overrides the record, that the strategy, that the defaults; the same from everywhere."""

from __future__ import annotations

import importlib.metadata
import json
import shutil
from pathlib import Path

import pytest
import torch
from cpdeform_toy.simulator import SimulatorToy

from cpdeform.cli.run import resolve_command
from cpdeform.core.errors import InputError, UnknownNameError
from cpdeform.core.placer import Stage
from cpdeform.core.plugins import load_registry
from cpdeform.core.state import initial_state
from cpdeform.core.task import changed_task, list_variants, load_task, task_path
from cpdeform.planning.optimizer import TrajectoryOptimizer
from cpdeform.planning.result import StageResult, Status
from cpdeform.planning.strategies.paper import PLACER_OPTIONS, StrategyPaper
from cpdeform.planning.strategy import Strategy
from cpdeform.report import draw_run
from cpdeform.run.deform import deform
from cpdeform.run.evaluation import evaluate_record
from cpdeform.run.origins import Origin
from cpdeform.run.record import RunRecorder
from cpdeform.run.record_reader import load_record
from cpdeform.run.resolve import PartObjects, resolve
from cpdeform.run.resume import OPTIONS_OF
from cpdeform.testing.placer import transport_of

SETTINGS = {
    "optimizer": {"iterations": 7, "learning_rate": 0.05},
    "objective": {"kind": "plasticinelab"},
    "priorities": {"kind": "displacement", "blur": 0.02},
    "placer_options": {"proposers": ["current"], "rounds": 2, "contacts": 3},
}
TOYS = {"backend": "toy", "ot": "toy", "placer": "toy"}


class StrategyOwn(Strategy):
    def settings(self, task, *, placer):
        return {key: value for key, value in SETTINGS.items() if key != "placer_options" or placer is None}


def every_task() -> list[str]:
    registry = load_registry()
    names = [name for name in registry.names("task") if task_path(name, registry=registry).is_file()]
    variants = {name: list_variants(task_path(name, registry=registry)) for name in names}
    return [f"{name}-{variant}" if variant else name for name in names for variant in variants[name] or [""]]


@pytest.fixture(scope="module")
def registry():
    return load_registry()


@pytest.fixture
def task(make_toy_task):
    return load_task(make_toy_task())


def resolved(task, registry, **given):
    return resolve(given, task=task, registry=registry, objects=PartObjects(strategy=StrategyOwn())).configuration


def test_the_strategy_fills_in_what_the_user_leaves_open(task, registry):
    found = resolved(task, registry, optimizer={"iterations": 3}, placer_options={"rounds": 1})
    assert (found.optimizer.iterations, found.optimizer.learning_rate, found.optimizer.patience) == (3, 0.05, 15)
    assert found.objective.kind == "plasticinelab"
    assert found.placer_options == {"proposers": ["current"], "rounds": 1, "contacts": 3}
    assert resolved(task, registry, **found.model_dump(exclude={"task"})) == found


def test_a_strategy_is_told_which_placer_its_options_would_go_to(task, registry):
    assert resolved(task, registry, placer="random").placer_options == {}


def test_unknown_settings_of_a_strategy_are_named(task, registry):
    class Wrong(StrategyOwn):
        def settings(self, task, *, placer):
            return {"optimizer": {"iteration": 3}}

    with pytest.raises(InputError, match=r"strategy cpdeform: settings.*iteration.*iterations"):
        resolve({}, task=task, registry=registry, objects=PartObjects(strategy=Wrong()))


def test_the_paper_sets_what_its_algorithm_says(registry):
    found = resolve({"task": "star", "strategy": "paper"}, registry=registry).configuration
    assert found.placer_options == dict(PLACER_OPTIONS["transport"])
    assert (found.optimizer.pruner, found.optimizer.backtrack, found.refinement.iterations) == ("none", None, 0)
    assert found.priorities.kind == "potential"
    mine = resolve({"task": "star", "strategy": "paper", "optimizer": {"pruner": "halving"}}, registry=registry).configuration
    assert mine.optimizer.pruner == "halving"
    assert resolve({"strategy": "paper", "placer": "random"}, registry=registry).configuration.placer_options == {"rounds": 1}


def test_the_papers_proposers_follow_the_number_of_tools(registry) -> None:
    labels = {}
    for name in ("torus", "airplane"):
        task = changed_task(load_task(name), scene={"bodies": {"0": {"particle_count": 500}}})
        options = StrategyPaper().settings(task, placer=None)["placer_options"]
        state = initial_state(task.scene, dtype=torch.float64)
        stage = Stage(0, task.scene, state, state.position[0], transport_of(state.position[0, :, 1]), torch.Generator())
        labels[name] = [item.label for item in registry.create("placer", "transport", **options).ask(stage)]
    assert labels == {"torus": ["direct"], "airplane": ["left-right", "top-bottom", "front-back"]}


def test_limits_of_the_tools_give_way_to_the_user_and_to_the_paper(make_toy_task, registry):
    limits = {"tools": {"0": {"action_scale": [0.004, 0.001, 0.004], "lower_bound": [0.0, 0.02, 0.0]}}}
    path = make_toy_task(limits=limits)
    own = load_task(path).scene.tools[0]

    def tool(**given):
        found = resolve({"task": str(path), **given}, registry=registry)
        assert found.task.limits == {}
        return found.task.scene.tools[0]

    assert (tool().action_scale, tool().lower_bound) == ((0.004, 0.001, 0.004), (0.0, 0.02, 0.0))
    mine = tool(scene={"tools": {"0": {"action_scale": [0.002, 0.002, 0.002]}}})
    assert (mine.action_scale, mine.lower_bound) == ((0.002, 0.002, 0.002), (0.0, 0.02, 0.0))
    assert tool(strategy="paper") == own


def test_a_simulator_given_as_an_object_has_the_scene_that_it_has(make_toy_task, registry):
    task = load_task(make_toy_task(limits={"tools": {"0": {"lower_bound": [0.0, 0.02, 0.0]}}}))
    for scene in (task.scene, resolve({}, task=task, registry=registry).task.scene):
        found = resolve({}, task=task, registry=registry, objects=PartObjects(simulator=SimulatorToy(scene)))
        assert found.task.scene == scene


def test_settings_in_a_task_file_are_refused_with_advice(make_toy_task):
    with pytest.raises(InputError, match=r"settings: got settings of a run, .*limits"):
        load_task(make_toy_task(settings={"optimizer": {"iterations": 3}}))


@pytest.mark.parametrize("strategy", ["cpdeform", "tuned", "paper"])
def test_every_task_resolves_to_the_same_run_from_everywhere(strategy, registry):
    for name in every_task():
        found = [
            resolve_command({"task": name, "strategy": strategy}, []),
            resolve({"task": name, "strategy": strategy}, registry=registry),
            resolve({"strategy": strategy}, task=load_task(name), registry=registry),
        ]
        first = found[0]
        assert first.configuration.task == first.task.name == name
        for other in found[1:]:
            assert other.configuration == first.configuration, name
            assert other.task == first.task, name
            assert type(other.strategy) is type(first.strategy)


def recorded(run, directory):
    """A record of a run whose first stage found no plan."""
    state = initial_state(run.task.scene, dtype=torch.float32)
    goal = torch.as_tensor(run.task.load_goal()).float()
    recorder = RunRecorder(directory, configuration=run.configuration)
    recorder.run_started(run.task, goal, run.names, run.configuration.seed)
    nothing = {"best": None, "actions": None, "positions": None, "tool_poses": None, "candidates": ()}
    recorder.stage_finished(
        StageResult(
            index=0,
            status=Status.NO_IMPROVEMENT,
            state_before=state,
            state=state,
            priorities=state.position[0, :, 0],
            loss_before=1.0,
            loss=1.0,
            gradient_evaluations=0,
            history=(),
            seconds={},
            **nothing,
        )
    )
    return load_record(directory)


def test_every_resumed_run_resolves_to_the_same(registry, tmp_path):
    for name in every_task():
        first = resolve({"task": name}, registry=registry)
        record = recorded(first, tmp_path / name)
        for other in (resolve({}, record=record, registry=registry), resolve({"task": name}, record=record, registry=registry)):
            stages = {"stages": first.configuration.stages}
            assert other.configuration.model_copy(update=stages) == first.configuration, name
            assert other.task.model_copy(update={"goal": first.task.goal}) == first.task, name
            assert (other.first_stage, len(other.previous)) == (1, 1)
        shutil.rmtree(tmp_path / name)


def test_a_resumed_run_resolves_to_the_same(make_toy_task, registry, tmp_path, toy_entry_points):
    """Wherever the record lies now, whatever became of the task's files, and in Python as on the command line."""
    path = make_toy_task(limits={"tools": {"0": {"lower_bound": [0.0, 0.02, 0.0]}}}, stage_count=3)
    toys = load_registry(toy_entry_points)
    settings = {**TOYS, "optimizer": {"iterations": 2}, "seed": 5}
    whole = resolve({"task": str(path), **settings}, registry=toys)
    whole.run().save(tmp_path / "whole")
    half = deform(str(path), settings=settings, stages=1, registry=toys)
    half.save(tmp_path / "half")
    shutil.move(tmp_path / "half", tmp_path / "elsewhere")
    path.unlink()
    (path.parent / "goal.npz").unlink()
    record = load_record(tmp_path / "elsewhere")
    assert torch.equal(torch.as_tensor(record.task.load_goal()).to(record.goal), record.goal)
    evaluation = evaluate_record(record)
    assert evaluation.wasserstein_final < evaluation.wasserstein_start
    assert draw_run(record.directory).is_file()
    rest = resolve({"stages": 2}, record=record, registry=toys)
    assert rest.configuration.model_copy(update={"stages": None}) == whole.configuration.model_copy(
        update={"task": rest.configuration.task}
    )
    assert (rest.first_stage, rest.configuration.stages) == (1, 2)
    assert rest.task.scene == whole.task.scene
    resumed = deform(resume=tmp_path / "elsewhere", stages=2, registry=toys)
    final = load_record(tmp_path / "whole")
    assert torch.equal(resumed.state.position, final.state.position)
    # Contact points that failed before the record's end are known, as they are in a run that goes through.
    assert [stage.index for stage in rest.previous] == [0]


def test_another_strategy_brings_its_own_settings_when_a_run_goes_on(task, registry, tmp_path, toy_entry_points):
    toys = load_registry(toy_entry_points)
    settings = {**TOYS, "optimizer": {"iterations": 2, "learning_rate": 0.07}}
    deform(task, settings=settings, stages=1, registry=toys).save(tmp_path / "half")
    record = load_record(tmp_path / "half")
    same = resolve({}, record=record, registry=toys).configuration
    assert (same.optimizer.iterations, same.optimizer.pruner) == (2, "halving")
    other = resolve({"strategy": "paper"}, record=record, registry=toys).configuration
    assert (other.optimizer.iterations, other.optimizer.pruner) == (24, "none")
    assert "placer_options" in OPTIONS_OF["strategy"]


def test_names_are_checked_before_anything_is_loaded(registry):
    for field, kind in (("backend", "simulator"), ("ot", "ot_solver"), ("placer", "placer"), ("strategy", "strategy")):
        with pytest.raises(UnknownNameError, match=f'{kind}: got "nothing"'):
            resolve({field: "nothing"}, registry=registry)


def test_records_of_the_first_format_are_read(tmp_path, task, toy_entry_points):
    """Made by the version before, whose configuration and task had other fields."""
    toys = load_registry(toy_entry_points)
    deform(task, settings={**TOYS, "optimizer": {"iterations": 2}}, stages=1, registry=toys).save(tmp_path / "old")
    file = Path(tmp_path / "old" / "run.json")
    run = json.loads(file.read_text())
    run["format"] = 1
    run["task"] |= {"settings": {"optimizer": {"iterations": 9}}, "goal": "/nowhere/goal.npz"}
    del run["task"]["limits"]
    configuration = run["configuration"]
    del configuration["strategy"], configuration["strategy_options"]
    configuration["algorithm"] = "paper"
    configuration["optimizer"]["schedule"] = {"none": "paper"}.get(configuration["optimizer"].pop("pruner"), "halving")
    configuration["priorities"] = {"kind": "potential", "blur": 0.004}
    configuration |= {"placer": "transport", "placer_options": {"poses": ["direct"], "attempts": 5}}
    file.write_text(json.dumps(run))
    record = load_record(tmp_path / "old")
    both = [*toy_entry_points, importlib.metadata.EntryPoint("placement", "cpdeform.placement.plugin", "cpdeform")]
    found = resolve({}, record=record, registry=load_registry(both)).configuration
    assert (found.strategy, found.optimizer.iterations, found.optimizer.pruner) == ("paper", 2, "halving")
    assert {"proposers", "rounds"} < set(found.placer_options)
    assert (found.placer_options["proposers"], found.placer_options["rounds"]) == (["direct"], 5)
    assert found.priorities.blur == 0.004


@pytest.mark.parametrize("section", ["priorities", "objective"])
def test_a_blur_next_to_nothing_is_refused(section, registry):
    with pytest.raises(InputError, match=rf"{section}\.blur: got 1e-30, expected .* 0\.000001"):
        resolve({section: {"blur": 1e-30}}, registry=registry)


@pytest.mark.parametrize(
    "changes",
    [
        {"format": [2]},
        {"format": "2"},
        {"format": 0},
        {"format": 1, "configuration": {"algorithm": ["paper"], "optimizer": {"schedule": ["paper"]}, "placer": {"a": 1}}},
        {"format": 1, "configuration": {"placer_options": {"poses": 3}, "placer": ["transport"]}},
    ],
)
def test_a_damaged_record_of_any_format_is_one_error(tmp_path, task, toy_entry_points, changes):
    toys = load_registry(toy_entry_points)
    deform(task, settings={**TOYS, "optimizer": {"iterations": 2}}, stages=1, registry=toys).save(tmp_path / "run")
    file = tmp_path / "run" / "run.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | changes))
    with pytest.raises(InputError):
        resolve({}, record=load_record(tmp_path / "run"), registry=toys)


@pytest.mark.parametrize(
    ("task", "given", "strategy"),
    [
        ("star", {}, "sculpt"),
        ("star", {"placer": "touch", "backend": "warp"}, "sculpt"),
        ("star", {"placer": "transport"}, "cpdeform"),
        ("star", {"optimizer": {"iterations": 3}}, "cpdeform"),
        ("star", {"strategy": "paper"}, "paper"),
        ("torus", {}, "cpdeform"),
    ],
)
def test_the_strategy_follows_from_the_task_and_from_what_is_given(registry, task, given, strategy):
    found = resolve({"task": task, **given}, registry=registry)
    assert found.configuration.strategy == found.names["strategy"] == strategy
    assert found.origins["strategy"] == (Origin.GIVEN.value if "strategy" in given else Origin.AUTO.value)
    assert found.configuration.placer == given.get("placer", "touch" if strategy == "sculpt" else "transport")


def test_with_an_optimizer_as_an_object_candidates_race(registry):
    objects = PartObjects(optimizer=TrajectoryOptimizer(iterations=2))
    assert resolve({"task": "star"}, registry=registry, objects=objects).configuration.strategy == "cpdeform"
