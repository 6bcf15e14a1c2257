"""The one resolver: from names, files and objects to a run that is ready to start.

Python (`cpdeform.deform`), the command line and the experiments all come through `resolve`, so that the same request is the same
run everywhere.
"""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from typing import Any

from torch import Tensor

from cpdeform.core.errors import InputError, PluginError
from cpdeform.core.forking import prepare_for_forks
from cpdeform.core.machine import available_cores
from cpdeform.core.objective import Objective
from cpdeform.core.old_names import current_options
from cpdeform.core.ot import OTSolver
from cpdeform.core.placer import Placer
from cpdeform.core.plugins import AUTO, Registry
from cpdeform.core.simulator import Simulator
from cpdeform.core.state import State
from cpdeform.core.task import Task, changed_task, limited_task, load_task, merge, validate
from cpdeform.planning.algorithm import Planner
from cpdeform.planning.effort import JointEffort
from cpdeform.planning.executor import Executor, ExecutorSerial
from cpdeform.planning.optimizer import TrajectoryOptimizer
from cpdeform.planning.result import Observer, StageResult
from cpdeform.planning.strategy import Parts, Strategy
from cpdeform.run.checks.check import warn_about_tools
from cpdeform.run.configuration import DEFAULT_EXECUTOR, RunConfiguration
from cpdeform.run.estimate import RunEstimate, estimate_run, stage_effort
from cpdeform.run.hook_observer import HookObserver
from cpdeform.run.origins import Origin, trace_origins
from cpdeform.run.parts import (
    make_objective,
    make_optimizer,
    make_priorities_solver,
    make_refinement,
    transport_problem,
)
from cpdeform.run.record_reader import RunRecord
from cpdeform.run.result import RunResult
from cpdeform.run.resume import check_same_task, resumed_task, resumed_values
from cpdeform.run.same_run import same_settings
from cpdeform.run.strategy_choice import choose_strategy
from cpdeform.run.unused_options import warn_about_optimizer

MAX_WORLDS = 16
"""Worlds that a simulator given by name holds at once; more candidates are computed in several batches."""

OWN_FIELDS: Mapping[str, str] = {"scene": "scene.<field>", "device": "device"}
"""Options of simulators that the configuration sets itself, and where."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class PartObjects:
    """Parts given as objects; None for those that the configuration names.

    Attributes:
        simulator: A simulator of the task's scene.
        ot_solver: Solves the placer's transport problem and, without `objective`, the loss's.
        placer: Proposes placements.
        strategy: Leads the search.
        objective: The loss. No refinement comes after it: it is what the user wants lowered.
        optimizer: Finds actions.
    """

    simulator: Simulator | None = None
    ot_solver: OTSolver | None = None
    placer: Placer | None = None
    strategy: Strategy | None = None
    objective: Objective | None = None
    optimizer: TrajectoryOptimizer | None = None


@dataclasses.dataclass(frozen=True, kw_only=True)
class ResolvedRun:
    """A run that is ready to start: nothing in it is left open.

    Attributes:
        configuration: All names and values, those of the strategy included.
        task: The task with all changes and limits in its scene.
        strategy: Leads the search.
        registry: Where names are looked up.
        objects: Parts given as objects.
        record: The record that the run goes on from; None for a run from the task's start.
        state: Where to start, a single world; None for the scene's start.
        first_stage: Number of the first stage.
        previous: The stages before it.
        continued: Whether these were made with the same parts and settings.
        origins: Where each value of the configuration comes from, see `cpdeform.run.origins`.
    """

    configuration: RunConfiguration
    task: Task
    strategy: Strategy
    registry: Registry
    objects: PartObjects = PartObjects()
    record: RunRecord | None = None
    state: State | None = None
    first_stage: int = 0
    previous: tuple[StageResult, ...] = ()
    continued: bool = False
    origins: Mapping[str, str] = dataclasses.field(default_factory=dict)

    @property
    def names(self) -> dict[str, str]:
        """Names or classes of the parts."""
        given = {
            "backend": self.objects.simulator,
            "ot": self.objects.ot_solver,
            "placer": self.objects.placer,
            "strategy": self.objects.strategy,
        }
        return {kind: getattr(self.configuration, kind) if part is None else type(part).__name__ for kind, part in given.items()}

    def executor(self) -> AbstractContextManager[Executor]:
        """What computes batches of worlds; with one worker it is this process."""
        name, workers = self.configuration.executor, self.configuration.workers
        if workers == 1:
            return contextlib.nullcontext(ExecutorSerial())
        made: AbstractContextManager[Executor] = self.registry.create(
            "executor", name, workers=workers, threads=self._threads(), **self.configuration.executor_options
        )
        return made

    def _threads(self) -> int:
        """Threads of each worker, those of this process included: what comes of a run does not depend on who computes it."""
        asked = self.configuration.simulator_options.get("threads")
        return asked if isinstance(asked, int) else max(1, available_cores() // self.configuration.workers)

    def planner(self, observers: Sequence[Observer] = (), *, executor: Executor | None = None) -> Planner:
        """Make the parts and put them together.

        Args:
            observers: Told of every iteration and stage, in order; the plugins' observers come after them.
            executor: Where batches of worlds are computed; defaults to this process.

        Raises:
            InputError: An option does not fit.
            MissingExtraError: A part's optional dependency is not installed.
        """
        configuration, registry, objects, task = self.configuration, self.registry, self.objects, self.task
        prepare_for_forks()
        warn_about_tools(task.scene)
        warn_about_optimizer(self.strategy, self.names["strategy"], origins=self.origins)
        placer = objects.placer
        if placer is None:
            named = registry.create("placer", configuration.placer, **configuration.placer_options)
            placer = self.strategy.placer(named, task=task)
        simulator = objects.simulator or registry.create(
            "simulator",
            configuration.backend,
            scene=task.scene,
            device=configuration.device,
            **{"batch_size": MAX_WORLDS, **self._share(), **configuration.simulator_options},
        )
        optimizer = objects.optimizer or make_optimizer(configuration.optimizer)
        problem = transport_problem(placer, configuration.priorities)
        loss_solver = objects.ot_solver or configuration.ot
        objective, refinement = objects.objective, None
        if objective is None:
            objective = make_objective(task, loss_solver, simulator, options=configuration.objective, registry=registry)
            refinement = make_refinement(
                task,
                loss_solver,
                simulator,
                options=configuration.refinement,
                blur=configuration.objective.blur,
                most=optimizer.iterations,
                registry=registry,
            )
        parts = Parts(task=task, placer=placer, objective=objective, optimizer=optimizer, refinement=refinement)
        return Planner(
            task=task,
            simulator=simulator,
            ot_solver=objects.ot_solver or make_priorities_solver(problem, configuration, registry=registry),
            problem=problem,
            placer=placer,
            objective=objective,
            phases=self.strategy.phases(parts),
            loop=self.strategy.loop,
            executor=executor or ExecutorSerial(),
            seed=configuration.seed,
            observers=(*observers, HookObserver(registry.manager)),
            names=self.names,
        )

    def _estimate_or_none(self, planner: Planner) -> RunEstimate | None:
        """The estimate; whatever makes it fail, the run itself tells better."""
        try:
            return self.estimate(planner)
        except Exception:
            return None

    def _share(self) -> dict[str, int]:
        """The simulator's threads where several processes share the cores."""
        known = self.registry.option_names("simulator", self.configuration.backend)
        return {"threads": self._threads()} if self.configuration.workers > 1 and known is not None and "threads" in known else {}

    def estimate(self, planner: Planner) -> RunEstimate:
        """What the run will take; measures a short rollout and its gradient.

        Args:
            planner: Its parts.

        Raises:
            InputError: There is not enough memory.
        """
        configuration = self.configuration
        effort = self.strategy.effort(stage_effort(planner))
        stages = configuration.stages or self.task.stage_count
        joint = self.joint_efforts(planner.simulator, stages=stages)
        return estimate_run(planner, stages=stages, workers=configuration.workers, effort=effort, joint=joint)

    def joint_efforts(self, simulator: Simulator, *, stages: int) -> tuple[JointEffort, ...]:
        """What the strategy's joint descents cost, counted from the stage that the run begins with; see `Strategy.joint_efforts`.

        Args:
            simulator: The run's simulator.
            stages: Number of stages of the run. Where it goes on as it began, its descents go over the stages before, too.
        """
        done = len(self.previous) if self.continued else 0
        efforts = self.strategy.joint_efforts(simulator, stages=done + stages)
        return tuple(dataclasses.replace(effort, after=effort.after - done) for effort in efforts if effort.after > done)

    def run(
        self, observers: Sequence[Observer] = (), *, on_estimate: Callable[[RunEstimate | None], None] | None = None
    ) -> RunResult:
        """Run it; as `cpdeform.deform`.

        Args:
            observers: Told of every iteration and stage, in order; the plugins' observers come after them.
            on_estimate: Told what the run will take, before it starts: None where that cannot be known. Without it nothing is
                measured.
        """
        with self.executor() as executor:
            planner = self.planner(observers, executor=executor)
            if on_estimate is not None:
                told = _Estimating(lambda: on_estimate(self._estimate_or_none(planner)))
                planner = dataclasses.replace(planner, observers=(*planner.observers, told))
            found = planner.run(
                stages=self.configuration.stages,
                state=self.state,
                first_stage=self.first_stage,
                previous=self.previous,
                continued=self.continued,
            )
        fields = {field.name: getattr(found, field.name) for field in dataclasses.fields(found)}
        return RunResult(**fields, configuration=self.configuration, resumed_from=self.record, origins=self.origins)


class _Estimating(Observer):
    """Tells what a run will take when it starts: once all is checked, so that nothing is measured for a run that cannot be."""

    def __init__(self, tell: Callable[[], None]) -> None:
        self._tell = tell

    def run_started(self, task: Task, goal: Tensor, names: dict[str, str], seed: int) -> None:
        """Tell."""
        self._tell()


def resolve(
    given: RunConfiguration | Mapping[str, Any],
    *,
    registry: Registry,
    task: Task | None = None,
    record: RunRecord | None = None,
    objects: PartObjects | None = None,
    state: State | None = None,
    first_stage: int = 0,
) -> ResolvedRun:
    """Resolve everything that a run needs.

    What the user gives overrides what the record says, that overrides what the strategy sets, and that the defaults. The task's
    scene has its limits in force, unless the strategy takes the scene as it is, and then the user's changes.

    Args:
        given: What the user set: fields of `RunConfiguration`, nested, or one whose unset fields do not count.
        registry: Where names are looked up.
        task: The task as an object, instead of the configuration's name.
        record: The record to go on from: its last state, its task and configuration.
        objects: Parts given as objects.
        state: Where to start, a single world, without a record.
        first_stage: Number of the first stage, without a record.

    Raises:
        InputError: A name, an option, the task or the record cannot be used.
        PluginError: Nothing is installed that ``"auto"`` could stand for.
    """
    objects = objects or PartObjects()
    values = given.model_dump(exclude_unset=True) if isinstance(given, RunConfiguration) else current_options(dict(given))
    asked = validate(RunConfiguration, values, source="configuration")
    layers: list[tuple[Origin, Mapping[str, Any]]] = [(Origin.GIVEN, values)]
    if record is not None:
        if task is not None or "task" in values:
            check_same_task(record, task if task is not None else load_task(asked.task, registry=registry))
        values = resumed_values(record, values)
        layers.append((Origin.RECORD, values))
        asked = validate(RunConfiguration, values, source="configuration")
    _check_names(asked, objects, registry=registry)
    if record is not None:
        task = resumed_task(record)
    elif task is None:
        task = load_task(asked.task, registry=registry)
    name = asked.strategy
    if name == AUTO:
        name = choose_strategy(task, values, race=any((objects.strategy, objects.placer, objects.optimizer)))
    strategy = objects.strategy or registry.create("strategy", name, **asked.strategy_options)
    task = _changed(_with_limits(task, strategy, objects), asked) if record is None else changed_task(task, scene=asked.scene)
    settings = strategy.settings(task, placer=values.get("placer"))
    values = {**values, "strategy": name}
    configuration = validate(RunConfiguration, merge(settings, values), source=f"strategy {name}: settings")
    layers.append((Origin.STRATEGY, settings))
    task_name = configuration.task if configuration.task.endswith((".yaml", ".yml")) else task.name
    configuration = configuration.model_copy(update={"task": task_name, **_chosen_parts(configuration, objects, registry=registry)})
    return ResolvedRun(
        configuration=configuration,
        task=task,
        strategy=strategy,
        registry=registry,
        objects=objects,
        record=record,
        state=state if record is None else record.state,
        first_stage=first_stage if record is None else record.next_stage,
        previous=() if record is None else record.stages,
        continued=record is not None and same_settings(record, configuration, task),
        origins=_origins(configuration, layers, asked, objects),
    )


def _origins(
    configuration: RunConfiguration,
    layers: Sequence[tuple[Origin, Mapping[str, Any]]],
    asked: RunConfiguration,
    objects: PartObjects,
) -> dict[str, str]:
    """Where each value comes from; names that "auto" or an object stands for, too."""
    origins = trace_origins(configuration.model_dump(mode="json"), layers)
    origins |= {name: Origin.AUTO.value for name in ("backend", "ot", "strategy") if getattr(asked, name) == AUTO}
    parts = {
        "backend": objects.simulator,
        "ot": objects.ot_solver,
        "placer": objects.placer,
        "strategy": objects.strategy,
        "objective.kind": objects.objective,
    }
    return origins | {name: Origin.OBJECT.value for name, part in parts.items() if part is not None}


def _chosen_parts(configuration: RunConfiguration, objects: PartObjects, *, registry: Registry) -> dict[str, str]:
    """Names of the simulator and of the transport solver, chosen where they are "auto"; all that is missing is told at once."""
    chosen, missing = {}, []
    for field, kind, part in (("backend", "simulator", objects.simulator), ("ot", "ot_solver", objects.ot_solver)):
        name = getattr(configuration, field)
        try:
            chosen[field] = name if part is not None else registry.resolve(kind, name, device=configuration.device)
        except PluginError as error:
            missing.append(error)
    if len(missing) > 1:
        remedy = 'pip install "cpdeform[all]" brings all of them.'
        raise PluginError(f"{' '.join(map(str, missing))} {remedy}") from missing[0]
    if missing:
        raise missing[0]
    return chosen


def _check_names(configuration: RunConfiguration, objects: PartObjects, *, registry: Registry) -> None:
    """Hold names and option groups against the registry, before anything slow is imported."""
    named = (
        ("simulator", configuration.backend, objects.simulator),
        ("ot_solver", configuration.ot, objects.ot_solver),
        ("placer", configuration.placer, objects.placer),
        ("strategy", configuration.strategy, objects.strategy),
        ("executor", configuration.executor, None),
    )
    for kind, name, part in named:
        if part is None and name != AUTO:
            registry.find(kind, name)
    if configuration.executor != DEFAULT_EXECUTOR and configuration.workers == 1:
        expected = f"at least 2 for the executor {configuration.executor}: one worker is this process"
        raise InputError("workers", came="1", expected=expected)
    for option, place in OWN_FIELDS.items():
        if option in configuration.simulator_options:
            remedy = f"Set {place} instead."
            raise InputError("simulator_options", came=f'"{option}"', expected="other options", remedy=remedy)


def _with_limits(task: Task, strategy: Strategy, objects: PartObjects) -> Task:
    """The task with its limits in force or, where the scene is taken as it is, left away."""
    without = task.model_copy(update={"limits": {}})
    if not strategy.keeps_limits:
        return without
    limited = limited_task(task)
    # A simulator given as an object has a scene already.
    if objects.simulator is not None and objects.simulator.scene != limited.scene:
        return without
    return limited


def _changed(task: Task, configuration: RunConfiguration) -> Task:
    return changed_task(
        task,
        scene=configuration.scene,
        goal=configuration.goal,
        step_count=configuration.steps,
        rest_steps=configuration.rest_steps,
    )
