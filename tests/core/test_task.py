from __future__ import annotations

import numpy as np
import pytest
import yaml

from cpdeform.core.errors import InputError, PluginError, UnknownNameError
from cpdeform.core.goal import load_goal_grid
from cpdeform.core.plugins import load_registry, split_options
from cpdeform.core.task import Task, list_variants, load_goal, load_task, merge, read_task, validate
from cpdeform.run.configuration import RunConfiguration


def test_reads_a_task(toy_task_file):
    task = load_task(str(toy_task_file))
    assert (task.name, task.step_count, task.scene.particle_count) == ("shift", 5, 60)
    assert task.load_goal().shape == (60, 3)
    assert Task.model_validate_json(task.model_dump_json()) == task


def test_variants(make_toy_task):
    variants = {"v1": None, "v2": {"step_count": 7, "scene": {"bodies": {"0": {"radius": 0.05}}}}, 3: {"step_count": 9}}
    path = make_toy_task(variants=variants)
    assert list_variants(path) == ["v1", "v2", "3"]
    assert read_task(path).name == "shift-v1"
    task = read_task(path, variant="v2")
    assert (task.name, task.step_count, task.scene.bodies[0].radius) == ("shift-v2", 7, 0.05)
    assert read_task(path, variant="3").step_count == 9
    with pytest.raises(UnknownNameError, match=r'variant of task shift: got "v4", expected one of 3, v1, v2'):
        read_task(path, variant="v4")


def test_names(toy_entry_points):
    registry = load_registry(toy_entry_points)
    with pytest.raises(UnknownNameError, match='Did you mean "toy"'):
        load_task("tyo", registry=registry)
    with pytest.raises(InputError, match="no such file"):
        load_task("toy", registry=registry)


def test_package_of_a_task_is_missing(monkeypatch, toy_entry_points):
    import cpdeform_toy.plugin

    from cpdeform.core.hookspecs import PluginSpec, hookimpl

    spec = PluginSpec("lost", "no_such_package:lost.yaml", "")
    monkeypatch.setattr(cpdeform_toy.plugin, "cpdeform_tasks", hookimpl(lambda: [spec]))
    with pytest.raises(PluginError, match="no_such_package"):
        load_task("lost", registry=load_registry(toy_entry_points))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("[1, 2]", "list"),
        ("a: [", "malformed YAML"),
        ("", "NoneType"),
        ("variants: 3", "variants"),
        ("variants: {v1: 3}", r"variants\.v1"),
        ("name: x", "field required"),
        (
            "name: x\nscen: {}\ngoal: t\nscene: {bodies: [{kind: sphere, position: [.5,.5,.5], radius: .1}]}",
            'Did you mean "scene"',
        ),
        ("goal: t\nscene: {bodies: [{kind: sphere, position: [.5,.5,.5], radius: -1}]}", r"bodies\.0\.sphere\.radius"),
        ("goal: t\nscene: {bodies: [{kind: sphere, position: [.5,.5,.5], radis: .1, radius: .1}]}", 'Did you mean "radius"'),
        ("goal: t\nscene: {bodies: [{kind: sphere, position: [.9,.9,.9], radius: .3}]}", "inside the domain"),
    ],
)
def test_bad_task_files(tmp_path, content, message):
    path = tmp_path / "task.yaml"
    path.write_text(content)
    with pytest.raises(InputError, match=message) as caught:
        read_task(path)
    assert str(path) in str(caught.value)


def test_unreadable_task_files(tmp_path):
    (tmp_path / "binary.yaml").write_bytes(b"\xff\xfe\x00")
    for name, message in (("absent.yaml", "no such file"), ("binary.yaml", "unreadable|malformed")):
        with pytest.raises(InputError, match=message):
            read_task(tmp_path / name)
    with pytest.raises(InputError, match="unreadable"):
        read_task(tmp_path)


def test_compact_goals(tmp_path, toy_task_file):
    scene = load_task(toy_task_file).scene
    np.save(tmp_path / "t.npy", np.full((2, 3), 2**15, dtype=np.uint16))
    np.testing.assert_array_equal(load_goal(tmp_path / "t.npy", scene=scene), np.full((2, 3), 0.5))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "no such file"),
        (b"", "unreadable"),
        (b"text", "unreadable"),
        (b"PK\x03\x04broken", "unreadable"),
        (np.zeros((0, 3)), "shape"),
        (np.zeros((4, 2)), "shape"),
        (np.zeros((4, 3), dtype=complex), "complex"),
        (np.full((4, 3), np.nan), "4 particles with nan"),
        (np.full((4, 3), 1.5), "4 of 4 particles outside the domain"),
        ({"other": np.zeros((4, 3))}, "no array of that name"),
    ],
)
def test_bad_goals(tmp_path, toy_task_file, content, message):
    path = tmp_path / "bad.npz"
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif isinstance(content, dict):
        np.savez(path, **content)
    elif content is not None:
        np.savez(path, position=content)
    with pytest.raises(InputError, match=message):
        load_goal(path, scene=load_task(toy_task_file).scene)


def test_merge():
    base = {"a": {"b": 1, "c": 2}, "d": ({"e": 1}, {"e": 2})}
    assert merge(base, {"a": {"b": 5}, "d": {"1": {"e": 7}}}) == {"a": {"b": 5, "c": 2}, "d": [{"e": 1}, {"e": 7}]}
    for index in ("2", "-1", "x"):
        with pytest.raises(InputError, match="an index from 0 to 1"):
            merge(base, {"d": {index: {}}})


def test_validate_names_field_and_flag_values():
    with pytest.raises(InputError, match=r"x: stages: got 0, expected a value greater than or equal to 1\."):
        validate(RunConfiguration, {"stages": 0}, source="x")
    with pytest.raises(InputError, match=r"1 more error\)"):
        validate(RunConfiguration, {"stages": 0, "seed": -1}, source="x")
    with pytest.raises(UnknownNameError, match=r'optimizer\.iteratons.*Did you mean "iterations"'):
        validate(RunConfiguration, {"optimizer": {"iteratons": 3}}, source="x")


def test_configuration_round_trip():
    configuration = validate(RunConfiguration, yaml.safe_load("{task: a, optimizer: {iterations: 3}}"), source="x")
    assert RunConfiguration.model_validate_json(configuration.model_dump_json()) == configuration


def test_one_rule_for_numbers_in_files_and_options(make_toy_task, tmp_path):
    path = make_toy_task()
    path.write_text(path.read_text().replace("particle_count: 60", "particle_count: 6e1"))
    assert load_task(path).scene.particle_count == 60
    options = split_options(["optimizer.iterations=1e1", "scene.time_step=1"])
    assert validate(RunConfiguration, options, source="x").optimizer.iterations == 10
    for value, message in (("true", "valid number"), ("'5'", "valid number"), ("1e308", "less than or equal")):
        path.write_text(make_toy_task().read_text().replace("scene:\n", f"scene:\n  time_step: {value}\n"))
        with pytest.raises(InputError, match=rf"scene\.time_step: got .*{message}"):
            load_task(path)


@pytest.mark.parametrize(
    "setting",
    ["optimizer.iterations=true", "optimizer.iterations='5'", "seed=1e19", "steps=1e8", "rest_steps=1e9", "stages=1.5", "seed=-1"],
)
def test_options_that_are_no_such_number(setting):
    with pytest.raises(InputError, match=setting.partition("=")[0]):
        validate(RunConfiguration, split_options([setting]), source="--set")


def test_a_misspelt_field_comes_before_what_it_left_missing():
    body = {"kind": "box", "position": [0.5, 0.5, 0.5], "width": [0.1, 0.1, 0.1]}
    with pytest.raises(UnknownNameError, match='Did you mean "widths"'):
        validate(Task, {"scene": {"bodies": [body]}}, source="x")
    with pytest.raises(UnknownNameError, match='Did you mean "learning_rate"'):
        validate(RunConfiguration, {"optimizer": {"lr": 0.1}, "seed": -1}, source="x")


def test_digits_of_other_scripts_are_no_index():
    for index in ("²", "٣", "9" * 5000):
        with pytest.raises(InputError, match="an index from 0 to 1"):
            merge({"bodies": [1, 2]}, {"bodies": {index: 3}})


@pytest.mark.parametrize("name", ["../x", "a/b", "a\\b", "", "x" * 200, "a\nb"])
def test_a_tasks_name_is_no_path(make_toy_task, name):
    with pytest.raises(InputError, match="name"):
        load_task(make_toy_task(name=name))


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"grid_cells": [[0, -1, 0]], "grid_mass": [1.0]}, "a node index -1, expected indices from 0 to 63"),
        ({"grid_cells": [[0, 0, 64]], "grid_mass": [1.0]}, "a node index 64"),
        ({"grid_cells": [[0, 0, 1], [0, 0, 1]], "grid_mass": [1.0, 2.0]}, "1 nodes more than once"),
        ({"grid_cells": [[0, 0, 1]], "grid_mass": [1j]}, "grid_mass: got complex128"),
        ({"grid_cells": [[0, 0, 1]], "grid_mass": [1e308]}, "grid_mass: got 1 values that are nan, infinite or huge"),
        ({"grid_cells": [[0, 0, 1]], "grid_mass": [-1.0]}, "negative masses"),
        ({"grid_cells": [[0, 0, 1]], "grid_mass": [1.0, 2.0]}, r"grid_mass: got float64 of shape \(2,\)"),
        ({"grid_cells": [[0.0, 0.0, 1.0]], "grid_mass": [1.0]}, "grid_cells: got float64"),
    ],
)
def test_bad_grids_of_goals(tmp_path, toy_task_file, arrays, message):
    np.savez(tmp_path / "bad.npz", position=np.full((4, 3), 0.5), **{name: np.array(values) for name, values in arrays.items()})
    with pytest.raises(InputError, match=message):
        load_goal_grid(tmp_path / "bad.npz", scene=load_task(toy_task_file).scene)


def test_another_format_as_goal_is_called_that(tmp_path, toy_task_file):
    (tmp_path / "goal.ply").write_text("ply\nformat ascii 1.0\n")
    with pytest.raises(InputError, match=r"it begins with .*ply.*expected an \.npz, \.npy or \.h5 file") as caught:
        load_goal(tmp_path / "goal.ply", scene=load_task(toy_task_file).scene)
    assert "pickle" not in str(caught.value)
