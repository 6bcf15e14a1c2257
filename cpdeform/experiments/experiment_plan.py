"""What an experiment runs: tasks, methods and seeds, and the configuration of each run."""

from __future__ import annotations

import dataclasses
import re
import zlib
from collections.abc import Iterable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

from cpdeform.core.errors import InputError, UnknownNameError
from cpdeform.core.plugins import Registry
from cpdeform.core.task import Task, changed_task, load_task, merge, validate
from cpdeform.run.configuration import RunConfiguration
from cpdeform.run.resolve import ResolvedRun, resolve

MULTI_STAGE, SINGLE_STAGE = "multi-stage", "single-stage"

TASKS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        MULTI_STAGE: ("airplane", "chair", "bottle", "star", "move++", "rope++", "writer++", "pinch"),
        SINGLE_STAGE: ("move", "triple-move", "torus", "rope", "rolling-pin", "chopsticks", "assembly", "table", "writer"),
    }
)
"""The tasks of each experiment."""

VARIANTS = ("v1", "v2", "v3")
"""Variants of the single-stage tasks that are run unless others are asked for."""

METHODS: Mapping[str, Mapping[str, Any]] = MappingProxyType(
    {
        "cpdeform": {"placer": "transport"},
        "tuned": {"placer": "transport", "strategy": "tuned"},
        "sculpt": {"strategy": "sculpt"},
        "paper": {"placer": "transport", "strategy": "paper"},
        "fixed": {"placer": "fixed"},
        "random": {"placer": "random"},
        "restarts": {"strategy": "restarts"},
        "bayesopt": {"strategy": "bayesopt"},
        "cma": {"strategy": "cma"},
        "mppi": {"strategy": "mppi"},
        "sampled-gradients": {"strategy": "sampled-gradients"},
        "sac": {"strategy": "sac"},
        "ppo": {"strategy": "ppo"},
        "td3": {"strategy": "td3"},
    }
)
"""What each method sets: this project's method, the same with settings tuned for each of the paper's tasks, many touches
from rest to rest, Algorithm 1 to the letter, PlasticineLab's protocol, the paper's ablation, and the searches and learners of
the distribution cpdeform-baselines."""

REFERENCE, BASELINE = "cpdeform", "fixed"
"""With equal evaluations the second gets as many as the first one used."""

OWN_OPTIONS: Mapping[str, str] = MappingProxyType(
    {"task": "--tasks", "seed": "--seeds", "placer": "--methods", "strategy": "--methods", "goal": "--goals"}
)
"""Fields of the configuration that the experiment sets itself, and the option to use instead."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ExperimentSettings:
    """What to run.

    Attributes:
        name: ``"multi-stage"`` or ``"single-stage"``.
        tasks: Registered names with their variants, or paths of YAML files; see `expand_tasks`.
        methods: Names of `METHODS`.
        seeds: Seeds.
        out: Directory of the records and tables.
        iterations: The most gradient steps per stage; defaults to what the strategy sets.
        stages: Number of stages; defaults to the task's own.
        particles: Number of particles of all bodies together, shared out as the task does; defaults to the task's own.
        goals: Directory with a goal ``<task name>.npz`` for every task, instead of the tasks' own.
        backend: Registered name of the simulator; defaults to that of `RunConfiguration`.
        ot: Registered name of the transport solver; defaults to that of `RunConfiguration`.
        device: ``"cpu"``, ``"cuda"`` or ``"cuda:N"``; defaults to that of `RunConfiguration`.
        options: Further fields of `RunConfiguration`, nested, for every run.
        equal_evaluations: Give ``fixed`` as many gradient evaluations per stage as ``cpdeform`` used.
        paper_metric: Also take W1 with the paper's settings.
        shape: Also take the shape figures, from rest to rest.
        equal_cost: Let every method spend as much a stage as ``cpdeform`` did, in gradient evaluations.

    Raises:
        InputError: A list is empty or holds something twice, a number is out of range, a method is unknown, or an option is one
            that the experiment sets itself.
    """

    name: str
    tasks: tuple[str, ...]
    out: Path
    methods: tuple[str, ...] = (REFERENCE, BASELINE)
    seeds: tuple[int, ...] = (0,)
    iterations: int | None = None
    stages: int | None = None
    particles: int | None = None
    goals: Path | None = None
    backend: str | None = None
    ot: str | None = None
    device: str | None = None
    options: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    equal_evaluations: bool = False
    paper_metric: bool = False
    shape: bool = False
    equal_cost: bool = False

    def __post_init__(self) -> None:
        for name in ("tasks", "methods", "seeds"):
            entries = getattr(self, name)
            if not entries or len(set(entries)) < len(entries):
                raise InputError(f"--{name}", came=", ".join(map(str, entries)) or "nothing", expected="entries, each once")
        for method in self.methods:
            if method not in METHODS:
                raise UnknownNameError("--methods", method, METHODS)
        for name in ("iterations", "stages", "particles"):
            number = getattr(self, name)
            if number is not None and number < 1:
                raise InputError(f"--{name}", came=str(number), expected="at least 1")
        if min(self.seeds) < 0:
            raise InputError("--seeds", came=str(min(self.seeds)), expected="0 or more")
        for field, option in OWN_OPTIONS.items():
            if field in self.options:
                raise InputError("--set", came=f'"{field}"', expected="another field", remedy=f"Use {option} instead.")
        if self.equal_evaluations and not {REFERENCE, BASELINE} <= set(self.methods):
            raise InputError("--equal-evaluations", came=", ".join(self.methods), expected=f"methods {REFERENCE} and {BASELINE}")
        if self.equal_cost and (REFERENCE not in self.methods or self.equal_evaluations):
            expected = f"methods with {REFERENCE}, and not --equal-evaluations"
            raise InputError("--methods", came=", ".join(self.methods), expected=expected)
        if self.goals is not None and not self.goals.is_dir():
            raise InputError("--goals", came=str(self.goals), expected="a directory")


@dataclasses.dataclass(frozen=True, kw_only=True)
class PlannedRun:
    """One run of an experiment.

    Attributes:
        task: The task's name with its variant, e.g. ``"move-v1"``.
        source: Registered name or path of a YAML file that it is loaded from.
        method: A name of `METHODS`.
        seed: The seed.
        directory: Where its record lies.
    """

    task: str
    source: str
    method: str
    seed: int
    directory: Path


def expand_tasks(names: Iterable[str], variants: Iterable[str], *, registry: Registry) -> tuple[str, ...]:
    """Names of tasks with each of the variants; a name with a variant, or of a YAML file, stays as it is.

    Args:
        names: Names of tasks, e.g. ``"move"`` or ``"move-v3"``, or paths of YAML files.
        variants: Names of variants; none for tasks without.
        registry: Where names are looked up.
    """
    known, variants = set(registry.names("task")), tuple(variants)
    return tuple(
        f"{name}-{variant}" if variant else name
        for name in names
        for variant in (variants if name in known and variants else ("",))
    )


def planned_runs(settings: ExperimentSettings, *, registry: Registry) -> list[PlannedRun]:
    """Every run in the order in which they are made: by task, seed, method, those that others depend on first.

    Raises:
        UnknownNameError: No plugin registers a task or a part, or there is no such variant.
        InputError: A task or an option cannot be used, or two tasks bear the same name.
    """
    tasks: dict[str, str] = {}
    for source in settings.tasks:
        name = load_task(source, registry=registry).name
        if name in tasks:
            raise InputError("--tasks", came=f"{tasks[name]} and {source}, both named {name}", expected="tasks of different names")
        tasks[name] = source
    validate(RunConfiguration, _values(settings, "writer", METHODS[settings.methods[0]], 0), source="experiment")
    for method in settings.methods:
        if "strategy" in METHODS[method]:
            registry.find("strategy", METHODS[method]["strategy"])
    for kind, part in (("simulator", settings.backend), ("ot_solver", settings.ot)):
        if part is not None:
            registry.resolve(kind, part, device=settings.device or "cpu")
    methods = [method for method in METHODS if method in settings.methods]
    return [
        PlannedRun(task=task, source=source, method=method, seed=seed, directory=record_directory(settings.out, task, method, seed))
        for task, source in tasks.items()
        for seed in settings.seeds
        for method in methods
    ]


def record_directory(out: Path, task: str, method: str, seed: int) -> Path:
    """Where the record of a run lies."""
    return out / re.sub(r"[^\w.+-]", "_", task) / f"{method}-seed{seed}"


def configure(
    run: PlannedRun,
    settings: ExperimentSettings,
    *,
    registry: Registry,
    iterations: int | None = None,
    budget: Mapping[str, Any] | None = None,
) -> ResolvedRun:
    """A run, ready to start.

    Args:
        run: The run.
        settings: Those of the experiment.
        registry: Where names are looked up.
        iterations: Gradient evaluations of each stage, all of which are made; defaults to those of `settings`.
        budget: Fields of the configuration that size the run, above those of `settings`.

    Raises:
        InputError: The task, its goal or an option cannot be used.
    """
    values = _values(_for_method(settings, run.method, registry), run.source, METHODS[run.method], run.seed)
    if iterations is not None:
        values = merge(values, {"optimizer": {"iterations": iterations, "patience": iterations}})
    values = merge(values, budget or {})
    if settings.particles is not None:
        values["scene"] = with_particles(load_task(run.source, registry=registry), values.get("scene", {}), settings.particles)
    if settings.goals is not None:
        values["goal"] = _goal(settings.goals, run.task)
    return resolve(validate(RunConfiguration, values, source="experiment"), registry=registry)


def _for_method(settings: ExperimentSettings, method: str, registry: Registry) -> ExperimentSettings:
    """The settings for a method: iterations that are meant for others of the experiment are left out, where it has its own."""
    strategy = METHODS[method].get("strategy")
    if strategy is None or len(settings.methods) == 1 or registry.load("strategy", strategy).takes_optimizer:
        return settings
    return dataclasses.replace(settings, iterations=None)


def _values(settings: ExperimentSettings, source: str, method: Mapping[str, Any], seed: int) -> dict[str, Any]:
    flags = {name: getattr(settings, name) for name in ("backend", "ot", "device", "stages")}
    given = {name: value for name, value in flags.items() if value is not None}
    if settings.iterations is not None:
        given["optimizer"] = {"iterations": settings.iterations}
    return merge(settings.options, {**given, **method, "task": source, "seed": seed})


def with_particles(task: Task, scene: Mapping[str, Any], total: int) -> dict[str, Any]:
    """Changes of the scene that give its bodies `total` particles, shared out as before, at least one each."""
    counts = [body.particle_count for body in changed_task(task, scene=scene).scene.bodies]
    if total < len(counts):
        raise InputError("--particles", came=str(total), expected=f"at least {len(counts)}, one for each body of {task.name}")
    shares = [count * total / sum(counts) for count in counts]
    shared = [max(1, int(share)) for share in shares]
    while sum(shared) != total:
        step = 1 if sum(shared) < total else -1
        able = [index for index, count in enumerate(shared) if count + step >= 1]
        shared[max(able, key=lambda index: step * (shares[index] - shared[index]))] += step
    return merge(scene, {"bodies": {str(index): {"particle_count": count} for index, count in enumerate(shared)}})


def _goal(goals: Path, task: str) -> Path:
    path = goals / f"{task}.npz"
    if not path.is_file():
        remedy = "Make it with `cpdeform task import-grid`, or leave --goals out."
        raise InputError(f"--goals: goal of {task}", came=f"no file {path.name}", expected="one for every task", remedy=remedy)
    return path


def plain_name(task: str) -> str:
    """The name of a task as a part of a file's name: it may hold what that cannot."""
    plain = re.sub(r"[^A-Za-z0-9_.+-]", "_", task).lstrip(".+-")
    return plain if plain == task else f"{plain}-{zlib.crc32(task.encode()):08x}"
