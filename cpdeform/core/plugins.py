"""Discovery of plugins through the entry-point group `cpdeform`, and lazy loading of what they register."""

from __future__ import annotations

import contextlib
import dataclasses
import importlib
import importlib.metadata
import inspect
import sys
import traceback
from collections.abc import Iterable, Mapping
from typing import Any

import pluggy

from cpdeform.core import hookspecs
from cpdeform.core.errors import CpdeformError, InputError, MissingExtraError, PluginError, UnknownNameError, brief
from cpdeform.core.hookspecs import PluginSpec

GROUP = "cpdeform"
KINDS: Mapping[str, str] = {
    "simulator": "cpdeform_simulators",
    "ot_solver": "cpdeform_ot_solvers",
    "placer": "cpdeform_placers",
    "strategy": "cpdeform_strategies",
    "task": "cpdeform_tasks",
    "job": "cpdeform_jobs",
    "engine": "cpdeform_engines",
    "executor": "cpdeform_executors",
    "command": "cpdeform_commands",
}
"""What can be registered, and the hook that registers it."""

_KEY_PARTS = 20
_MISSING = object()

AUTO = "auto"
"""The name that stands for the fastest simulator or transport solver that is installed; see `PluginSpec.automatic`."""


@dataclasses.dataclass(frozen=True)
class Registration:
    """A registered part and where it comes from.

    Attributes:
        kind: One of `KINDS`.
        spec: What the plugin says about it.
        distribution: Name and version of the installed distribution.
        entry_point: Name of the entry point.
    """

    kind: str
    spec: PluginSpec
    distribution: str
    entry_point: str


@dataclasses.dataclass(frozen=True)
class PluginFailure:
    """A plugin, or a part of one, that could not be loaded; reported, never fatal.

    Attributes:
        entry_point: Name of the entry point.
        distribution: Name and version of the installed distribution.
        reason: The error, in one line.
        details: The traceback.
    """

    entry_point: str
    distribution: str
    reason: str
    details: str


class Registry:
    """All parts that the installed plugins register; made anew by `load_registry`, never shared.

    Attributes:
        manager: The pluggy manager that holds the loaded plugins.
        failures: Plugins, or single parts of them, that could not be loaded. Of two parts of the same name the first is kept.
    """

    def __init__(
        self, manager: pluggy.PluginManager, registrations: Iterable[Registration], failures: Iterable[PluginFailure]
    ) -> None:
        self.manager = manager
        self._parts: dict[tuple[str, str], Registration] = {}
        found = list(failures)
        for registration in registrations:
            key = (registration.kind, registration.spec.name)
            first = self._parts.setdefault(key, registration)
            if first is not registration:
                spec = registration.spec
                reason = (
                    f'PluginError: {registration.kind} "{spec.name}" ({spec.target}) is registered already, by '
                    f"{first.distribution} ({first.spec.target}). Uninstall one of them."
                )
                found.append(PluginFailure(registration.entry_point, registration.distribution, reason, ""))
        self.failures = tuple(found)

    def registrations(self, kind: str | None = None) -> list[Registration]:
        """Registered parts of one kind, or of all, sorted by kind and name."""
        return [self._parts[key] for key in sorted(self._parts) if kind is None or key[0] == kind]

    def names(self, kind: str) -> list[str]:
        """Names registered for a kind."""
        return [registration.spec.name for registration in self.registrations(kind)]

    def installed(self, kind: str) -> dict[str, Any]:
        """The parts of a kind that can be imported, by name: those whose optional dependencies are installed."""
        found = {}
        for name in self.names(kind):
            with contextlib.suppress(CpdeformError):
                found[name] = self.load(kind, name)
        return found

    def find(self, kind: str, name: str) -> Registration:
        """Look a part up by name.

        Raises:
            UnknownNameError: No plugin registers the name; the message holds the nearest one.
        """
        registration = self._parts.get((kind, name))
        if registration is None:
            remedy = "Run `cpdeform plugins` to see what is installed."
            if self.failures:
                remedy += (
                    " Plugins that failed to load: " + ", ".join(dict.fromkeys(item.entry_point for item in self.failures)) + "."
                )
            raise UnknownNameError(kind, name, self.names(kind), remedy=remedy)
        return registration

    def load(self, kind: str, name: str) -> Any:
        """Import and return the object that a name stands for.

        Raises:
            UnknownNameError: No plugin registers the name.
            MissingExtraError: An optional dependency is not installed; the message holds the command that installs it.
            PluginError: The target does not exist, or its import fails.
        """
        spec = self.find(kind, name).spec
        module_name, _, attribute = spec.target.partition(":")
        try:
            with redirect_prints():
                part = getattr(importlib.import_module(module_name), attribute, _MISSING)
        except (CpdeformError, KeyboardInterrupt):
            raise
        except BaseException as error:
            raise _import_error(kind, spec, error) from error
        if part is _MISSING:
            raise PluginError(f'{kind} "{name}": module {module_name} has no attribute "{attribute}".')
        if not callable(part):
            raise PluginError(f'{kind} "{name}": {spec.target} is {type(part).__name__}, which cannot be called.')
        return part

    def resolve(self, kind: str, name: str, *, device: str) -> str:
        """The name that ``"auto"`` stands for on a device; any other name as it is.

        Args:
            kind: ``"simulator"`` or ``"ot_solver"``.
            name: What the user typed.
            device: ``"cpu"``, ``"cuda"`` or ``"cuda:N"``.

        Raises:
            UnknownNameError: No plugin registers the name.
            PluginError: ``"auto"`` has nothing to choose from: no ranked part for the device can be imported.
        """
        if name != AUTO:
            return self.find(kind, name).spec.name
        device_type = device.partition(":")[0]
        ranked = [item.spec for item in self.registrations(kind) if device_type in item.spec.automatic]
        ranked.sort(key=lambda spec: -spec.automatic[device_type])
        for spec in ranked:
            with contextlib.suppress(CpdeformError):
                self.load(kind, spec.name)
                return spec.name
        installs = " or ".join(f'pip install "{spec.extra}"' for spec in ranked if spec.extra)
        remedy = f"Try {installs}." if installs else "Run `cpdeform plugins` to see what is installed."
        raise PluginError(f'{kind} "{AUTO}": nothing that is installed runs on {device_type}. {remedy}')

    def option_names(self, kind: str, name: str) -> list[str] | None:
        """Load a part and return the names of its keyword options; None where it takes any.

        Raises:
            UnknownNameError: No plugin registers the name.
            MissingExtraError: An optional dependency is not installed; the message holds the command that installs it.
        """
        return _option_names(self.load(kind, name))

    def create(self, kind: str, name: str, /, **options: Any) -> Any:
        """Load a part and call it with options.

        Raises:
            InputError: The part does not take one of the options, or not this value of it.
            MissingExtraError: An optional dependency is not installed; the message holds the command that installs it.
            PluginError: The part makes nothing, or what it raises is no matter of its options.
        """
        factory = self.load(kind, name)
        known = _option_names(factory)
        for option in options:
            if known is not None and option not in known:
                raise UnknownNameError(f"option of {kind} {name}", option, known)
        try:
            with redirect_prints():
                part = factory(**options)
        except (CpdeformError, KeyboardInterrupt):
            raise
        except ModuleNotFoundError as error:
            raise _import_error(kind, self.find(kind, name).spec, error) from error
        except (TypeError, ValueError) as error:
            # Options come from the command line as any YAML value; the full scene among them would drown the message.
            given = {key: value for key, value in options.items() if isinstance(value, (str, int, float, list, dict))}
            raise InputError(
                f"options of {kind} {name}", came=str(given or "none"), expected=f"values that it accepts ({error})"
            ) from error
        except MemoryError:
            raise
        except BaseException as error:
            raise PluginError(f'{kind} "{name}" cannot be made: {describe(error)}') from error
        if part is None:
            raise PluginError(f'{kind} "{name}": {self.find(kind, name).spec.target} made nothing (None).')
        return part


def _import_error(kind: str, spec: PluginSpec, error: BaseException) -> CpdeformError:
    """What to raise when importing a part raised `error`: a missing extra is the user's to install, the rest is the plugin's."""
    module_name = spec.target.partition(":")[0]
    missing = error.name if isinstance(error, ModuleNotFoundError) else None
    if spec.extra and missing and not f"{module_name}.".startswith(f"{missing}."):
        return MissingExtraError(kind, spec.name, module=missing, install=f'pip install "{spec.extra}"')
    return PluginError(f'{kind} "{spec.name}": cannot import {module_name}: {describe(error)}')


def _option_names(factory: Any) -> list[str] | None:
    """Names of a factory's keyword parameters; None where it takes any."""
    try:
        parameters = inspect.signature(factory).parameters.values()
    except (TypeError, ValueError):
        # Some callables that are not written in Python do not tell.
        return None
    if any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters):
        return None
    return [parameter.name for parameter in parameters]


def _distribution(entry_point: importlib.metadata.EntryPoint) -> str:
    distribution = entry_point.dist
    return f"{distribution.name} {distribution.version}" if distribution is not None else "unknown distribution"


def describe(error: BaseException) -> str:
    """An error in one line: its type and its text."""
    text = f"called sys.exit({error.code!r})" if isinstance(error, SystemExit) else brief(str(error), 300)
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


def redirect_prints() -> contextlib.AbstractContextManager[Any]:
    """Have what plugins print while they are loaded go to stderr: stdout may be for a program to read."""
    return contextlib.redirect_stdout(sys.stderr)


def _register(
    manager: pluggy.PluginManager, entry_point: importlib.metadata.EntryPoint
) -> tuple[list[Registration], list[PluginFailure]]:
    """Load one entry point; what it registers, and the parts of it that cannot be used.

    Whatever keeps the whole plugin from being loaded is raised, for the caller to report.
    """
    plugin = entry_point.load()
    distribution = _distribution(entry_point)
    manager.register(plugin, name=f"{distribution}:{entry_point.name}")
    found: list[Registration] = []
    failures: list[PluginFailure] = []
    try:
        manager.check_pending()
    except BaseException:
        manager.unregister(plugin)
        raise
    for kind, hook in KINDS.items():
        try:
            for spec in _called(manager, plugin, hook):
                try:
                    found.append(Registration(kind, _checked(spec, hook), distribution, entry_point.name))
                except PluginError as error:
                    failures.append(_failure(entry_point, error))
        except KeyboardInterrupt:
            raise
        except BaseException as error:
            failures.append(_failure(entry_point, error))
    return found, failures


def _called(manager: pluggy.PluginManager, plugin: object, hook: str) -> list[Any]:
    """What a plugin's implementations of a hook return, put together."""
    implementations = [item for item in getattr(manager.hook, hook).get_hookimpls() if item.plugin is plugin]
    specs: list[Any] = []
    for implementation in implementations:
        returned = implementation.function()
        if not isinstance(returned, (list, tuple)):
            raise PluginError(f"{hook} must return a list of PluginSpec, got {brief(repr(returned), 100)}")
        specs.extend(returned)
    return specs


def _checked(spec: Any, hook: str) -> PluginSpec:
    """What a plugin says about a part, if it has the right form."""
    if not isinstance(spec, PluginSpec):
        raise PluginError(f'{hook} must return PluginSpec with target "module:attribute", got {brief(repr(spec), 100)}')
    texts = {"name": spec.name, "target": spec.target, "summary": spec.summary, "extra": spec.extra}
    for field, value in texts.items():
        if not isinstance(value, str):
            raise PluginError(f"{hook}: {field} must be a text, got {brief(repr(value), 100)}")
    if not spec.name.strip() or not all(spec.target.partition(":")):
        raise PluginError(f'{hook}: part "{spec.name}" must have a name and a target "module:attribute", got "{spec.target}"')
    ranks = spec.automatic.items() if isinstance(spec.automatic, Mapping) else [(None, None)]
    for device, rank in ranks:
        if not isinstance(device, str) or not isinstance(rank, int):
            raise PluginError(f'{hook}: automatic of "{spec.name}" must be ranks by device, got {brief(repr(spec.automatic), 100)}')
    return spec


def _failure(entry_point: importlib.metadata.EntryPoint, error: BaseException) -> PluginFailure:
    reason = brief(describe(error), 300)
    details = "".join(traceback.format_exception(error))
    return PluginFailure(entry_point.name, _distribution(entry_point), reason, details)


def _order(entry_point: importlib.metadata.EntryPoint) -> tuple[bool, str, str, str]:
    """Where a plugin stands among the others: this package's own first, so that none can take the place of its parts."""
    distribution = _distribution(entry_point)
    return (distribution.partition(" ")[0] != GROUP, entry_point.name, distribution, entry_point.value)


def load_registry(entry_points: Iterable[importlib.metadata.EntryPoint] | None = None) -> Registry:
    """Discover all plugins.

    Args:
        entry_points: What to load; defaults to the installed entry points of the group `cpdeform`.

    Returns:
        A fresh registry. What cannot be used, plugins or single parts of them, is in its `failures`; everything else works.
    """
    manager = pluggy.PluginManager(GROUP)
    manager.add_hookspecs(hookspecs)
    registrations: list[Registration] = []
    failures: list[PluginFailure] = []
    chosen = importlib.metadata.entry_points(group=GROUP) if entry_points is None else entry_points
    for entry_point in sorted(chosen, key=_order):
        try:
            with redirect_prints():
                found, failed = _register(manager, entry_point)
        except KeyboardInterrupt:
            raise
        except BaseException as error:
            failures.append(_failure(entry_point, error))
        else:
            registrations.extend(found)
            failures.extend(failed)
    return Registry(manager, registrations, failures)


def split_options(values: Iterable[str]) -> dict[str, Any]:
    """Read ``key=value`` assignments, values as YAML, dots nesting: ``a.b=1`` gives ``{"a": {"b": 1}}``.

    Raises:
        InputError: An assignment has no ``=``, its value is not YAML, its key has too many parts, or a key is set both as a value
            and as a group.
    """
    from cpdeform.core.reading.yaml_text import parse_yaml

    result: dict[str, Any] = {}
    for value in values:
        key, equals, text = value.partition("=")
        if not equals or not all(part.strip() for part in key.split(".")):
            remedy = "For example --set optimizer.learning_rate=0.05"
            raise InputError("--set", came=f'"{value}"', expected="key=value", remedy=remedy)
        if key.count(".") >= _KEY_PARTS:
            raise InputError("--set", came=f'"{key}"', expected=f"a key of at most {_KEY_PARTS} parts")
        node = result
        *parents, last = key.strip().split(".")
        for parent in parents:
            node = node.setdefault(parent, {})
            if not isinstance(node, dict):
                raise InputError("--set", came=f'"{key}"', expected=f'"{parent}" to be set once, as a value or as a group')
        if isinstance(node.get(last), dict):
            raise InputError("--set", came=f'"{key}"', expected=f'"{last}" to be set once, as a value or as a group')
        node[last] = parse_yaml(text, argument=f"--set {brief(key, 60)}")
    return result
