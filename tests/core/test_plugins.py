from __future__ import annotations

import importlib.metadata
import re
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
        plugin(
            monkeypatch,
            "b",
            cpdeform_stage_finished=lambda result: seen.append(("b", result)),
            cpdeform_stages_revised=lambda result: seen.append(("b", result)),
        ),
    ]
    observer = HookObserver(load_registry(points).manager)
    with pytest.warns(RuntimeWarning, match=r"plugin .*:a: cpdeform_stage_finished failed with RuntimeError: disk full"):
        observer.stage_finished("stage")
    observer.stages_revised("revision")
    observer.run_finished("run")
    assert seen == [("b", "stage"), ("b", "revision"), ("a", "run")]


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


def test_of_two_parts_of_a_name_the_first_stays_and_the_other_is_listed(monkeypatch):
    points = [
        plugin(monkeypatch, name, cpdeform_placers=lambda target=f"{name}:x": [PluginSpec("same", target, "")])
        for name in ("b", "a")
    ]
    for order in (points, points[::-1]):
        registry = load_registry(order)
        assert registry.find("placer", "same").spec.target == "a:x"
        (failure,) = registry.failures
        assert failure.entry_point == "b"
        assert re.search(r'placer "same" \(b:x\) is registered already, by .*\(a:x\)', failure.reason)


def test_no_plugin_takes_the_place_of_a_built_in_part(monkeypatch):
    mine = plugin(monkeypatch, "aaa", cpdeform_simulators=lambda: [PluginSpec("warp", "json:loads", "")])
    registry = load_registry([mine, *importlib.metadata.entry_points(group="cpdeform")])
    assert registry.find("simulator", "warp").spec.target.startswith("cpdeform.")
    assert "aaa" in [failure.entry_point for failure in registry.failures]


class Bare(BaseException):
    """Neither an error nor an exit."""


def raising(error):
    def factory(**options):
        raise error

    return factory


@pytest.mark.parametrize(
    ("returned", "reason"),
    [
        (None, "must return a list"),
        (5, "must return a list"),
        ([PluginSpec(None, "a:b", "")], "name must be a text"),
        ([PluginSpec(" ", "a:b", "")], "must have a name"),
        ([PluginSpec("x", "a", "")], "target"),
        ([PluginSpec("x", 3, "")], "target must be a text"),
        ([PluginSpec("x", "a:b", None)], "summary must be a text"),
        ([PluginSpec("x", "a:b", "", automatic={"cpu": "high"})], "ranks by device"),
        ([PluginSpec("x", "a:b", "", automatic=3)], "ranks by device"),
    ],
)
def test_a_part_of_the_wrong_form_is_listed_and_the_others_of_its_plugin_work(monkeypatch, returned, reason):
    good = [PluginSpec("good", "json:dumps", "")]
    beside = [*good, *returned] if isinstance(returned, list) else returned
    found = load_registry([plugin(monkeypatch, "a", cpdeform_simulators=lambda: beside, cpdeform_placers=lambda: good)])
    (failure,) = found.failures
    assert reason in failure.reason
    assert found.names("placer") == ["good"]
    assert found.names("simulator") == (["good"] if isinstance(returned, list) else [])


@pytest.mark.parametrize("error", [SystemExit(0), SystemExit("bye"), Bare("odd"), RuntimeError("x" * 5000), GeneratorExit()])
def test_what_a_plugin_raises_stays_with_it(monkeypatch, error):
    module = types.ModuleType("made_parts")
    module.make, module.nothing, module.number = raising(error), lambda: None, 3
    monkeypatch.setitem(sys.modules, module.__name__, module)
    parts = [PluginSpec(name, f"made_parts:{name}", "", automatic={"cpu": 9}) for name in ("make", "nothing", "number")]
    points = [plugin(monkeypatch, "a", cpdeform_tasks=raising(error), cpdeform_placers=lambda: parts)]
    registry = load_registry(points)
    (failure,) = registry.failures
    assert type(error).__name__ in failure.reason
    assert len(failure.reason) <= 300
    for name, reason in (("make", type(error).__name__), ("nothing", "made nothing"), ("number", "cannot be called")):
        with pytest.raises(PluginError, match=reason):
            registry.create("placer", name)


def test_auto_passes_over_a_part_that_exits_when_it_is_imported(monkeypatch, tmp_path, capsys):
    (tmp_path / "made_exiting.py").write_text("print('hello')\nimport sys\nsys.exit(0)\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    specs = [
        PluginSpec("exits", "made_exiting:x", "", automatic={"cpu": 9}),
        PluginSpec("works", "json:loads", "", automatic={"cpu": 1}),
    ]
    registry = load_registry([plugin(monkeypatch, "a", cpdeform_simulators=lambda: specs)])
    assert registry.resolve("simulator", "auto", device="cpu") == "works"
    assert set(registry.installed("simulator")) == {"works"}
    with pytest.raises(PluginError, match=r"called sys\.exit\(0\)"):
        registry.load("simulator", "exits")
    written = capsys.readouterr()
    assert "hello" in written.err
    assert not written.out


def test_an_interruption_passes(monkeypatch):
    with pytest.raises(KeyboardInterrupt):
        load_registry([plugin(monkeypatch, "a", cpdeform_tasks=raising(KeyboardInterrupt()))])
    module = types.ModuleType("made_interrupted")
    module.make = raising(KeyboardInterrupt())
    monkeypatch.setitem(sys.modules, module.__name__, module)
    spec = PluginSpec("x", "made_interrupted:make", "")
    registry = load_registry([plugin(monkeypatch, "b", cpdeform_placers=lambda: [spec])])
    with pytest.raises(KeyboardInterrupt):
        registry.create("placer", "x")


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
