"""The parts of a run that a configuration describes: losses, refinement, and the solver of the placer's transport problem."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import torch

from cpdeform.core.errors import InputError, UnknownNameError
from cpdeform.core.objective import Objective
from cpdeform.core.ot import OTSolver, TransportProblem
from cpdeform.core.placer import Placer
from cpdeform.core.plugins import Registry
from cpdeform.core.priorities import DISPLACEMENT_EXPONENT
from cpdeform.core.simulator import Simulator
from cpdeform.core.task import Task
from cpdeform.planning.metrics import goal_mass_grid
from cpdeform.planning.objectives.density import ObjectiveDensity
from cpdeform.planning.objectives.mass import mass_grid
from cpdeform.planning.objectives.plasticinelab import ObjectivePlasticineLab
from cpdeform.planning.objectives.shape import ObjectiveShape
from cpdeform.planning.objectives.soft_iou import ObjectiveSoftIoU
from cpdeform.planning.objectives.transport import ObjectiveTransport
from cpdeform.planning.optimizer import TrajectoryOptimizer
from cpdeform.planning.pruner import make_pruner
from cpdeform.run.configuration import (
    ObjectiveConfiguration,
    OptimizerConfiguration,
    PrioritiesConfiguration,
    RefinementConfiguration,
    RunConfiguration,
)


def make_optimizer(options: OptimizerConfiguration) -> TrajectoryOptimizer:
    """The optimiser that a configuration describes."""
    values = options.model_dump()
    return TrajectoryOptimizer(**{**values, "pruner": make_pruner(options.pruner)})


def transport_problem(placer: Placer, options: PrioritiesConfiguration) -> TransportProblem | None:
    """The placer's transport problem under what a configuration says; None where the placer has none."""
    problem = placer.transport_problem
    if problem is None:
        return None
    if options.kind is not None:
        problem = dataclasses.replace(problem, exponent=DISPLACEMENT_EXPONENT if options.kind == "displacement" else 1)
    return problem if options.blur is None else dataclasses.replace(problem, blur=options.blur)


def make_priorities_solver(problem: TransportProblem | None, configuration: RunConfiguration, *, registry: Registry) -> OTSolver:
    """The solver of the placer's transport problem, with the cost that it needs.

    Raises:
        InputError: The solver cannot solve for that cost.
    """
    asked = problem or TransportProblem()
    wished = {} if asked.tolerance is None else {"tolerance": asked.tolerance}
    options = {"blur": asked.blur, **configuration.ot_options}
    if asked.exponent != 1:
        options["exponent"] = asked.exponent
    name = configuration.ot
    try:
        return _solver_with(name, wished, options, registry=registry)
    except UnknownNameError as error:
        if asked.exponent == 1 or error.name != "exponent":
            raise
        raise InputError(
            "priorities.kind",
            came='"displacement"',
            expected=f'"potential", since the transport solver {name} has no option exponent',
            remedy="Set it with --set priorities.kind=potential, or choose another solver with --ot.",
        ) from error


def _solver_with(name: str, wished: Mapping[str, Any], options: Mapping[str, Any], *, registry: Registry) -> OTSolver:
    """A solver with the options that it has to have, and those that are only wished for if it knows them."""
    solver: OTSolver
    try:
        solver = registry.create("ot_solver", name, **{**wished, **options})
    except UnknownNameError as error:
        if error.name not in wished or error.name in options:
            raise
        solver = registry.create("ot_solver", name, **options)
    return solver


def _named_solver(name: str, *, blur: float, registry: Registry) -> OTSolver:
    solver: OTSolver = registry.create("ot_solver", name, blur=blur)
    return solver


def make_objective(
    task: Task, ot_solver: OTSolver | str, simulator: Simulator, *, registry: Registry, options: ObjectiveConfiguration
) -> Objective:
    """The loss that a configuration describes.

    Args:
        task: Its goal is wanted.
        ot_solver: A solver used as it is, or a registered name, created with the blur of `options`.
        simulator: Gives device and type.
        registry: Where the name is looked up.
        options: Kind, subset size, blur, refresh schedule, contact weight.
    """
    goal = torch.as_tensor(task.load_goal()).to(device=simulator.device, dtype=simulator.dtype)
    if options.kind == "plasticinelab":
        grid = task.load_goal_grid()
        return ObjectivePlasticineLab(
            task.scene,
            mass_grid(goal, task.scene) if grid is None else torch.as_tensor(grid).to(goal),
            contact_weight=1.0 if options.contact_weight is None else options.contact_weight,
            contact=options.contact,
        )
    solver = ot_solver
    if isinstance(solver, str):
        solver = _named_solver(solver, blur=options.blur, registry=registry)
    transport = ObjectiveTransport(
        solver,
        goal,
        scene=task.scene,
        points=options.points,
        refresh=options.refresh,
        contact_weight=options.contact_weight or 0.0,
        coast_steps=options.coast_steps,
        axis_scale=options.axis_scale,
    )
    if options.kind == "transport":
        return transport
    start = simulator.initial_state(batch_size=1).position[0]
    weights = {"density_weight": options.density_weight, "collision_weight": options.collision_weight}
    return ObjectiveShape(transport, task.scene, goal, start, **weights)


def make_refinement(
    task: Task,
    ot_solver: OTSolver | str,
    simulator: Simulator,
    *,
    options: RefinementConfiguration,
    blur: float,
    most: int,
    registry: Registry,
) -> tuple[Objective, TrajectoryOptimizer] | None:
    """Loss and optimiser of the refinement that a configuration describes; None for none.

    Args:
        task: Its goal is wanted, with the node masses of its file where it has them.
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
        grid = goal_mass_grid(task, torch.as_tensor(task.load_goal()).double())
        objective = ObjectiveSoftIoU(task.scene, grid) if options.kind == "iou" else ObjectiveDensity(task.scene, grid)
    optimizer = TrajectoryOptimizer(iterations=iterations, learning_rate=options.learning_rate, patience=options.patience)
    return objective, optimizer
