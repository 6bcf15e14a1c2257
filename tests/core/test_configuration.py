"""What a run is made of: what the user sets, above what the algorithm prescribes, above what the task says."""

from __future__ import annotations

import pytest
import torch

from cpdeform.core.configuration import PAPER_PLACER_OPTIONS, PrioritiesConfiguration, RunConfiguration, with_task_settings
from cpdeform.core.deform import configured_task, deform
from cpdeform.core.errors import InputError
from cpdeform.core.placer import Stage
from cpdeform.core.plugins import load_registry
from cpdeform.core.state import initial_state
from cpdeform.core.task import changed_task, load_task, validate


@pytest.fixture
def task(make_toy_task):
    settings = {
        "optimizer": {"iterations": 7, "learning_rate": 0.05},
        "objective": {"kind": "plasticinelab"},
        "priorities": {"kind": "displacement", "blur": 0.02},
        "placer_options": {"poses": ["current"], "attempts": 2, "contacts": 3},
    }
    return load_task(make_toy_task(settings=settings))


def test_the_task_fills_in_what_the_user_leaves_open(task):
    asked = RunConfiguration.model_validate({"optimizer": {"iterations": 3}, "placer_options": {"attempts": 1}})
    found = with_task_settings(asked, task)
    assert (found.optimizer.iterations, found.optimizer.learning_rate, found.optimizer.patience) == (3, 0.05, 15)
    assert found.objective.kind == "plasticinelab"
    assert found.placer_options == {"poses": ["current"], "attempts": 1, "contacts": 3}
    assert with_task_settings(found, task) == found


def test_options_of_the_tasks_placer_do_not_go_to_another_one(task):
    assert with_task_settings(RunConfiguration(placer="random"), task).placer_options == {}
    paper = with_task_settings(RunConfiguration(placer="fixed", algorithm="paper"), task)
    assert paper.placer_options == {}
    assert paper.optimizer.schedule == "paper"


def test_the_papers_algorithm_goes_above_the_tasks_settings(task):
    found = with_task_settings(RunConfiguration(algorithm="paper"), task)
    assert found.placer_options == dict(PAPER_PLACER_OPTIONS["transport"])
    assert with_task_settings(RunConfiguration(algorithm="paper", placer="random"), task).placer_options == {"rounds": 1}
    assert (found.optimizer.schedule, found.optimizer.iterations) == ("paper", 7)
    assert found.priorities == PrioritiesConfiguration()
    mine = RunConfiguration.model_validate({"algorithm": "paper", "optimizer": {"schedule": "halving"}})
    assert with_task_settings(mine, task).optimizer.schedule == "halving"


@pytest.mark.parametrize("name", ["move", "move++", "rope++", "star", "table"])
def test_no_option_of_a_task_is_left_under_the_papers_algorithm(name):
    found = with_task_settings(RunConfiguration(algorithm="paper"), load_task(name))
    assert found.placer_options == dict(PAPER_PLACER_OPTIONS["transport"])
    assert found.refinement.iterations == 0


def test_limits_of_the_tasks_tools_give_way_to_the_user_and_to_the_paper(make_toy_task):
    limits = {"manipulators": {"0": {"action_scale": [0.004, 0.001, 0.004], "lower_bound": [0.0, 0.02, 0.0]}}}
    path = make_toy_task(settings={"scene": limits})
    own, registry = load_task(path).scene.manipulators[0], load_registry()

    def tool(**options):
        return configured_task(RunConfiguration(task=str(path), **options), registry=registry).scene.manipulators[0]

    assert (tool().action_scale, tool().lower_bound) == ((0.004, 0.001, 0.004), (0.0, 0.02, 0.0))
    mine = tool(scene={"manipulators": {"0": {"action_scale": [0.002, 0.002, 0.002]}}})
    assert (mine.action_scale, mine.lower_bound) == ((0.002, 0.002, 0.002), (0.0, 0.02, 0.0))
    assert tool(algorithm="paper") == own


def test_limits_of_the_tasks_tools_count_in_python_where_all_is_named(make_toy_task):
    limits = {"manipulators": {"0": {"lower_bound": [0.0, 0.02, 0.0]}}}
    path = make_toy_task(settings={"scene": limits, "optimizer": {"iterations": 1}})
    assert deform(str(path), stages=1).task.scene.manipulators[0].lower_bound == (0.0, 0.02, 0.0)
    task = load_task(path)
    assert deform(task, stages=1).task.scene == task.scene


def test_unknown_settings_of_a_task_are_named(make_toy_task):
    task = load_task(make_toy_task(settings={"optimizer": {"iteration": 3}}))
    with pytest.raises(InputError, match=r"task shift: settings.*iteration.*iterations"):
        with_task_settings(RunConfiguration(), task)


def test_the_papers_poses_follow_the_number_of_tools() -> None:
    """A single tool is placed by the score alone, however many poses the task's own settings name."""
    registry = load_registry()
    labels = {}
    for name in ("torus", "airplane"):
        task = load_task(name)
        few = {"bodies": {"0": {"particle_count": 500}}}
        task = changed_task(task, scene=few)
        options = with_task_settings(RunConfiguration(algorithm="paper"), task).placer_options
        state = initial_state(task.scene, dtype=torch.float64)
        priorities = state.position[0, :, 1].clone()
        stage = Stage(0, task.scene, state, state.position[0], priorities, torch.Generator())
        labels[name] = [placement.label for placement in registry.create("placer", "transport", **options).ask(stage)]
    assert labels == {"torus": ["direct"], "airplane": ["left-right", "top-bottom", "front-back"]}


@pytest.mark.parametrize("section", ["priorities", "objective"])
def test_a_blur_next_to_nothing_is_refused(section):
    with pytest.raises(InputError, match=rf"{section}\.blur: got 1e-30, expected .* 0\.000001"):
        validate(RunConfiguration, {section: {"blur": 1e-30}}, source="options")
