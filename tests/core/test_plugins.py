from __future__ import annotations

import importlib.metadata
import sys
import types

import pytest

from cpdeform.core.errors import InputError, MissingExtraError, PluginError, UnknownNameError
from cpdeform.core.hookspecs import PluginSpec, hookimpl
from cpdeform.core.plugins import KINDS, load_registry, split_options
from cpdeform.run.hook_observer import HookObserver


def plugin(monkeypatch: pytest.MonkeyPatch, name: str, **attributes: object) -> importlib.metadata.EntryPoint:
    """An entry point of a module made here; functions become hook implementations."""
    module = types.ModuleType(f"made_{name}")
    for key, value in attributes.items():
        setattr(module, key, hookimpl(value) if callable(value) else value)
    monkeypatch.setitem(sys.modules, module.__name__, module)
    return importlib.metadata.EntryPoint(name, module.__name__, "cpdeform")


@pytest.mark.parametrize(("kind", "hook"), KINDS.items())
def test_each_registering_hook(monkeypatch, kind, hook):
    spec = PluginSpec("mine", "collections:OrderedDict", "summary")
    registry = load_registry([plugin(monkeypatch, "a", **{hook: lambda: [spec]})])
    assert not registry.failures
    assert registry.names(kind) == ["mine"]
    assert [item.kind for item in registry.registrations()] == [kind]
    assert registry.find(kind, "mine").entry_point == "a"
    assert registry.load(kind, "mine").__name__ == "OrderedDict"


def test_observer_hooks_survive_a_failing_plugin(monkeypatch):
    seen = []

    def fail(result):
        raise RuntimeError("disk full")

    points = [
        plugin(monkeypatch, "a", cpdeform_stage_finished=fail, cpdeform_run_finished=lambda result: seen.append(("a", result))),
        plugin(monkeypatch, "b", cpdeform_stage_finished=lambda result: seen.append(("b", result))),
    ]
    observer = HookObserver(load_registry(points).manager)
    with pytest.warns(RuntimeWarning, match=r"plugin .*:a: cpdeform_stage_finished failed with RuntimeError: disk full"):
        observer.stage_finished("stage")
    observer.run_finished("run")
    assert seen == [("b", "stage"), ("a", "run")]


def test_broken_plugins_are_reported_and_the_others_work(monkeypatch):
    good = plugin(monkeypatch, "good", cpdeform_placers=lambda: [PluginSpec("good", "json:dumps", "")])
    points = [
        good,
        importlib.metadata.EntryPoint("absent", "no_such_module_anywhere", "cpdeform"),
        plugin(monkeypatch, "unknown", cpdeform_simulatorz=lambda: []),
        plugin(monkeypatch, "raises", cpdeform_tasks=lambda: 1 / 0),
        plugin(monkeypatch, "text", cpdeform_tasks=lambda: ["writer"]),
        plugin(monkeypatch, "exits", cpdeform_tasks=lambda: sys.exit(3)),
    ]
    registry = load_registry(points)
    reasons = {failure.entry_point: failure.reason for failure in registry.failures}
    assert set(reasons) == {"absent", "unknown", "raises", "text", "exits"}
    assert "no_such_module_anywhere" in reasons["absent"]
    assert "cpdeform_simulatorz" in reasons["unknown"]
    assert "ZeroDivisionError" in reasons["raises"]
    assert registry.names("placer") == ["good"]
    with pytest.raises(UnknownNameError, match=r"Plugins that failed to load: absent, exits, raises"):
        registry.find("placer", "godo")


def test_duplicates_name_both(monkeypatch):
    points = [
        plugin(monkeypatch, name, cpdeform_placers=lambda target=f"{name}:x": [PluginSpec("same", target, "")])
        for name in ("a", "b")
    ]
    with pytest.raises(PluginError, match=r'placer "same" is registered twice: .*a:x.*b:x'):
        load_registry(points)


def test_unknown_name_suggests_the_nearest(toy_entry_points):
    registry = load_registry(toy_entry_points)
    with pytest.raises(UnknownNameError, match=r'simulator: got "tyo", expected one of toy, toy-missing. Did you mean "toy"\?'):
        registry.find("simulator", "tyo")


def test_missing_extra_tells_the_command(toy_entry_points):
    with pytest.raises(MissingExtraError, match=r'pip install "cpdeform-toy\[more\]"'):
        load_registry(toy_entry_points).load("simulator", "toy-missing")


def test_targets_that_cannot_be_loaded(monkeypatch):
    broken = types.ModuleType("made_broken")
    broken.__path__ = []
    specs = [PluginSpec("attribute", "json:nothing", ""), PluginSpec("module", "json.nothing:x", "", extra="x[y]")]
    registry = load_registry([plugin(monkeypatch, "a", cpdeform_placers=lambda: specs)])
    with pytest.raises(PluginError, match='no attribute "nothing"'):
        registry.load("placer", "attribute")
    # The missing module is the plugin's own, so that installing an extra would not help.
    with pytest.raises(PluginError, match=r"json\.nothing"):
        registry.load("placer", "module")


def test_create_checks_options(toy_entry_points):
    registry = load_registry(toy_entry_points)
    assert registry.create("placer", "toy", count=2).count == 2
    with pytest.raises(UnknownNameError, match=r'option of placer toy: got "cuont".*Did you mean "count"'):
        registry.create("placer", "toy", cuont=2)
    with pytest.raises(InputError, match=r"options of ot_solver toy: got \{'blur': 'wide'\}"):
        registry.create("ot_solver", "toy", blur="wide")


def ranked(monkeypatch, *specs):
    return load_registry([plugin(monkeypatch, "ranked", cpdeform_simulators=lambda: list(specs))])


def test_auto_is_the_highest_rank_of_the_device_that_can_be_imported(monkeypatch):
    registry = ranked(
        monkeypatch,
        PluginSpec("never", "json:loads", ""),
        PluginSpec("slow", "json:loads", "", automatic={"cpu": 1, "cuda": 9}),
        PluginSpec("fast", "json:loads", "", automatic={"cpu": 5}),
        PluginSpec("absent", "json:loads_from_nowhere", "", automatic={"cpu": 10}),
    )
    assert registry.resolve("simulator", "auto", device="cpu") == "fast"
    assert registry.resolve("simulator", "auto", device="cuda:1") == "slow"
    assert registry.resolve("simulator", "never", device="cpu") == "never"
    with pytest.raises(UnknownNameError, match="fats"):
        registry.resolve("simulator", "fats", device="cpu")


def test_auto_without_anything_tells_what_to_install(monkeypatch):
    spec = PluginSpec("absent", "no_such_module_at_all:x", "", extra="some[thing]", automatic={"cpu": 1})
    with pytest.raises(PluginError, match=r'"auto": nothing that is installed runs on cpu\. Try pip install "some\[thing\]"'):
        ranked(monkeypatch, spec).resolve("simulator", "auto", device="cpu")


def test_auto_has_a_choice_among_the_built_in_parts():
    registry = load_registry()
    for kind in ("simulator", "ot_solver"):
        assert registry.resolve(kind, "auto", device="cpu") in registry.names(kind)


def test_built_in_plugins_are_registered():
    registry = load_registry()
    assert not registry.failures
    assert "warp" in registry.names("simulator")
    assert {"geomloss", "pot"} <= set(registry.names("ot_solver"))
    assert {"transport", "fixed"} <= set(registry.names("placer"))
    assert "writer" in registry.names("task")


def test_split_options():
    options = split_options(["a.b=1", "a.c=[1e-3, x]", "d=1e-3", "e=", "f=x=y", "g.0.h=true"])
    assert options == {"a": {"b": 1, "c": [1e-3, "x"]}, "d": 1e-3, "e": None, "f": "x=y", "g": {"0": {"h": True}}}
    assert split_options(["a=1", "a=2"]) == {"a": 2}


@pytest.mark.parametrize("values", [["a"], ["=1"], ["a..b=1"], ["a=["], ["a=1", "a.b=2"], ["a.b=1", "a=2"]])
def test_split_options_refuses(values):
    with pytest.raises(InputError, match="--set"):
        split_options(values)
