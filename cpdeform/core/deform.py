"""`deform`: one call from a task to a plan, parts given by name or as objects."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch

from cpdeform.core.algorithm import Planner
from cpdeform.core.configuration import (
    ObjectiveConfiguration,
    RefinementConfiguration,
    RunConfiguration,
    with_task_settings,
)
from cpdeform.core.errors import InputError, UnknownNameError
from cpdeform.core.forking import prepare_for_forks
from cpdeform.core.hook_observer import HookObserver
from cpdeform.core.metrics import target_mass_grid
from cpdeform.core.objective import Objective
from cpdeform.core.objectives.density import ObjectiveDensity
from cpdeform.core.objectives.plasticinelab import ObjectivePlasticineLab, mass_grid
from cpdeform.core.objectives.soft_iou import ObjectiveSoftIoU
from cpdeform.core.objectives.transport import ObjectiveTransport
from cpdeform.core.optimizer import TrajectoryOptimizer
from cpdeform.core.ot import OTSolver
from cpdeform.core.placer import Placer
from cpdeform.core.plugins import AUTO, Registry, load_registry
from cpdeform.core.priorities import DISPLACEMENT_EXPONENT, PriorityKind
from cpdeform.core.refinement import Refinement
from cpdeform.core.result import DeformResult, Observer
from cpdeform.core.resume import Resumption
from cpdeform.core.simulator import Simulator
from cpdeform.core.state import State
from cpdeform.core.task import Task, changed_task, load_task
from cpdeform.tasks.checks.check import warn_about_tools

MAX_WORLDS = 16
"""Candidates that are solved as one batch; more are solved in several."""


def deform(
    task: Task | str = "writer",
    *,
    simulator: Simulator | str = AUTO,
    ot_solver: OTSolver | str = AUTO,
    placer: Placer | str | None = None,
    objective: Objective | None = None,
    optimizer: TrajectoryOptimizer | None = None,
    device: str = "cpu",
    seed: int = 0,
    stages: int | None = None,
    state: State | None = None,
    first_stage: int = 0,
    observers: Sequence[Observer] = (),
    registry: Registry | None = None,
) -> DeformResult:
    """Plan how the tools of a task turn its body into its goal (paper, Algorithm 1).

    Args:
        task: A task, a registered name, or the path of a YAML file. Where both task and simulator are given by name, the limits
            that the task's settings put on its tools count; a scene given as an object is used as it is.
        simulator: A simulator of the task's scene, or a registered name; ``"auto"`` is the fastest one that is installed.
        ot_solver: A transport solver or a registered name, or ``"auto"``; it gives the priorities and, unless `objective` is given,
            the loss.
        placer: A placer or a registered name; what the task's settings say where absent, or else ``"transport"``.
        objective: The loss; what the task's settings say where absent, or else the transport cost of the last step's particles
            to the goal.
        optimizer: Finds actions; defaults to `TrajectoryOptimizer` with the task's settings. A refinement that these ask for makes
            no more iterations than it, and none where `objective` is given.
        device: Where a simulator given by name runs, ``"cpu"`` or ``"cuda"``.
        seed: Seed of first actions and random placements.
        stages: Number of stages; the task's own where absent.
        state: Where to start, a single world, e.g. the last state of a run record; the scene's start where absent.
        first_stage: Number of the first stage: `RunRecord.next_stage` for a run that goes on from a record.
        observers: Told of every iteration and stage, in order; the plugins' observers come after them.
        registry: Where names are looked up; the installed plugins where absent.

    Returns:
        Stages, losses, metric and status; `DeformResult.save` writes the run record.

    Raises:
        InputError: A name, an option or the task cannot be used.
        CapabilityError: The parts do not fit together.
    """
    prepare_for_forks()
    registry = registry or load_registry()
    if isinstance(simulator, str):
        simulator = registry.resolve("simulator", simulator, device=device)
    if isinstance(ot_solver, str):
        ot_solver = registry.resolve("ot_solver", ot_solver, device=device)
    named = isinstance(task, str)
    task = load_task(task, registry=registry) if isinstance(task, str) else task
    defaults = with_task_settings(RunConfiguration(**({"placer": placer} if isinstance(placer, str) else {})), task)
    if named and isinstance(simulator, str):
        task = changed_task(task, scene=defaults.scene)
    warn_about_tools(task.scene)
    placer = defaults.placer if placer is None else placer
    names = {"backend": _part_name(simulator), "ot": _part_name(ot_solver), "placer": _part_name(placer)}
    used_placer: Placer = _part(placer, "placer", registry, **defaults.placer_options)
    options = {"scene": task.scene, "batch_size": MAX_WORLDS, "device": device}
    used_simulator: Simulator = _part(simulator, "simulator", registry, **options)
    used_optimizer = optimizer or TrajectoryOptimizer(**defaults.optimizer.model_dump())
    refinement = None
    # A loss given as an object is what the user wants lowered: no other one comes after it.
    if objective is None:
        objective = make_objective(task, ot_solver, used_simulator, options=defaults.objective, registry=registry)
        refinement = make_refinement(
            task,
            ot_solver,
            used_simulator,
            options=defaults.refinement,
            blur=defaults.objective.blur,
            most=used_optimizer.iterations,
            registry=registry,
        )
    # A solver given as an object has a cost of its own; its potentials are priorities whatever the cost.
    kind: PriorityKind = defaults.priorities.kind if isinstance(ot_solver, str) else "potential"
    used_solver = _priorities_solver(ot_solver, defaults, registry=registry) if isinstance(ot_solver, str) else ot_solver
    planner = Planner(
        task=task,
        simulator=used_simulator,
        ot_solver=used_solver,
        placer=used_placer,
        objective=objective,
        optimizer=used_optimizer,
        priority_kind=kind,
        refinement=refinement,
        seed=seed,
        observers=(*observers, HookObserver(registry.manager)),
        names=names,
    )
    return planner.run(stages=stages, state=state, first_stage=first_stage)


def _part_name(part: object) -> str:
    return part if isinstance(part, str) else type(part).__name__


def _part(part: Any, kind: str, registry: Registry, **options: Any) -> Any:
    """A part given as an object, or the one that a name stands for, created with options."""
    return registry.create(kind, part, **options) if isinstance(part, str) else part


def _priorities_solver(name: str, configuration: RunConfiguration, *, registry: Registry) -> OTSolver:
    """The solver that gives the priorities, with the cost that their kind needs."""
    options = {"blur": configuration.priorities.blur, **configuration.ot_options}
    if configuration.priorities.kind == "displacement":
        options["exponent"] = DISPLACEMENT_EXPONENT
    try:
        solver: OTSolver = registry.create("ot_solver", name, **options)
    except UnknownNameError as error:
        if configuration.priorities.kind == "potential" or error.name != "exponent":
            raise
        raise InputError(
            "priorities.kind",
            came='"displacement"',
            expected=f'"potential", since the transport solver {name} has no option exponent',
            remedy="Set it with --set priorities.kind=potential, or choose another solver with --ot.",
        ) from error
    return solver


def deform_configuration(
    configuration: RunConfiguration,
    *,
    resumption: Resumption | None = None,
    observers: Sequence[Observer] = (),
    registry: Registry | None = None,
) -> DeformResult:
    """Run what a configuration describes; the command line's way to `deform`.

    Args:
        configuration: Names and options of all parts.
        resumption: The run to go on with, see `cpdeform.core.resume`; the configuration's task from its start where absent.
        observers: Told of every iteration and stage, in order; the plugins' observers come after them.
        registry: Where names are looked up; the installed plugins where absent.

    Returns:
        As `deform`.

    Raises:
        InputError: A name, an option or the task cannot be used.
        CapabilityError: The parts do not fit together.
    """
    prepare_for_forks()
    registry = registry or load_registry()
    check_names(configuration, registry=registry)
    task = configured_task(configuration, registry=registry) if resumption is None else resumption.task
    configuration = resolved(configuration, registry=registry, task=task if resumption is None else None)
    warn_about_tools(task.scene)
    placer = registry.create("placer", configuration.placer, **configuration.placer_options)
    simulator_options = {"batch_size": MAX_WORLDS, **configuration.simulator_options}
    simulator = registry.create(
        "simulator", configuration.backend, scene=task.scene, device=configuration.device, **simulator_options
    )
    ot_solver = _priorities_solver(configuration.ot, configuration, registry=registry)
    objective = make_objective(task, configuration.ot, simulator, options=configuration.objective, registry=registry)
    planner = Planner(
        task=task,
        simulator=simulator,
        ot_solver=ot_solver,
        placer=placer,
        objective=objective,
        optimizer=TrajectoryOptimizer(**configuration.optimizer.model_dump()),
        priority_kind=configuration.priorities.kind,
        refinement=make_refinement(
            task,
            configuration.ot,
            simulator,
            options=configuration.refinement,
            blur=configuration.objective.blur,
            most=configuration.optimizer.iterations,
            registry=registry,
        ),
        seed=configuration.seed,
        observers=(*observers, HookObserver(registry.manager)),
        names={"backend": configuration.backend, "ot": configuration.ot, "placer": configuration.placer},
    )
    if resumption is None:
        return planner.run(stages=configuration.stages)
    return planner.run(
        stages=configuration.stages,
        state=resumption.state,
        first_stage=resumption.first_stage,
        previous=resumption.record.stages,
    )


def resolved(configuration: RunConfiguration, *, registry: Registry, task: Task | None = None) -> RunConfiguration:
    """The configuration with all that the user left open: names in the place of ``"auto"``, and the task's settings.

    Args:
        configuration: What the user set.
        registry: Where names are looked up.
        task: The task whose settings count; None where a record's configuration holds them already.

    Raises:
        InputError: The task's settings do not fit.
        UnknownNameError: No plugin registers one of the names.
        PluginError: Nothing is installed that ``"auto"`` could stand for.
    """
    if task is not None:
        configuration = with_task_settings(configuration, task)
    device = configuration.device
    names = {
        "backend": registry.resolve("simulator", configuration.backend, device=device),
        "ot": registry.resolve("ot_solver", configuration.ot, device=device),
    }
    return configuration.model_copy(update=names)


def check_names(configuration: RunConfiguration, *, registry: Registry) -> None:
    """Hold the names and option groups of a configuration against the registry, before anything slow is imported.

    Raises:
        UnknownNameError: No plugin registers one of the names.
        InputError: An option of the simulator belongs elsewhere.
    """
    for kind, name in (("simulator", configuration.backend), ("ot_solver", configuration.ot), ("placer", configuration.placer)):
        if name != AUTO:
            registry.find(kind, name)
    for option, place in (("scene", "scene.<field>"), ("device", "device")):
        if option in configuration.simulator_options:
            remedy = f"Set {place} instead."
            raise InputError("simulator_options", came=f'"{option}"', expected="other options", remedy=remedy)


def configured_task(configuration: RunConfiguration, *, registry: Registry) -> Task:
    """Load a configuration's task and apply the changes of the scene, the goal and the number of steps: its own and the user's.

    Raises:
        InputError: The task or a change cannot be used.
    """
    task = load_task(configuration.task, registry=registry)
    configuration = with_task_settings(configuration, task)
    return changed_task(
        task,
        scene=configuration.scene,
        target=configuration.target,
        step_count=configuration.steps,
        rest_steps=configuration.rest_steps,
    )


def make_objective(
    task: Task,
    ot_solver: OTSolver | str,
    simulator: Simulator,
    *,
    registry: Registry,
    options: ObjectiveConfiguration,
) -> Objective:
    """The loss that a configuration describes.

    Args:
        task: Its target is the goal.
        ot_solver: A solver used as it is, or a registered name, created with the blur of `options`.
        simulator: Gives device and type.
        registry: Where the name is looked up.
        options: Kind, subset size, blur, refresh schedule, contact weight.
    """
    target = torch.as_tensor(task.load_target()).to(device=simulator.device, dtype=simulator.dtype)
    if options.kind == "plasticinelab":
        grid = task.load_target_grid()
        return ObjectivePlasticineLab(
            task.scene,
            mass_grid(target, task.scene) if grid is None else torch.as_tensor(grid).to(target),
            contact_weight=1.0 if options.contact_weight is None else options.contact_weight,
            contact=options.contact,
        )
    solver: OTSolver = _part(ot_solver, "ot_solver", registry, blur=options.blur)
    return ObjectiveTransport(
        solver,
        target,
        scene=task.scene,
        points=options.points,
        refresh=options.refresh,
        contact_weight=options.contact_weight or 0.0,
        coast_steps=options.coast_steps,
        axis_scale=options.axis_scale,
    )


def make_refinement(
    task: Task,
    ot_solver: OTSolver | str,
    simulator: Simulator,
    *,
    options: RefinementConfiguration,
    blur: float,
    most: int,
    registry: Registry,
) -> Refinement | None:
    """The refinement that a configuration describes; None for none.

    Args:
        task: Its target is the goal, with the node masses of its file where it has them.
        ot_solver: As for `make_objective`; for the kind ``"transport"``.
        simulator: Gives device and type.
        options: Kind, iterations, step size, patience.
        blur: Entropic blur of the kind ``"transport"``, length units.
        most: The most iterations, whatever the options say; those of the search.
        registry: Where the name is looked up.
    """
    iterations = min(options.iterations, most)
    if iterations == 0:
        return None
    objective: Objective
    if options.kind == "transport":
        plain = ObjectiveConfiguration(points=None, blur=blur)
        objective = make_objective(task, ot_solver, simulator, options=plain, registry=registry)
    else:
        grid = target_mass_grid(task, torch.as_tensor(task.load_target()).double())
        objective = ObjectiveSoftIoU(task.scene, grid) if options.kind == "iou" else ObjectiveDensity(task.scene, grid)
    return Refinement(
        objective=objective,
        optimizer=TrajectoryOptimizer(iterations=iterations, learning_rate=options.learning_rate, patience=options.patience),
    )
