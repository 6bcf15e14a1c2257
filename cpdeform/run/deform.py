"""`deform`: one call from a task to a plan, parts given by name or as objects."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from cpdeform.core.objective import Objective
from cpdeform.core.ot import OTSolver
from cpdeform.core.placer import Placer
from cpdeform.core.plugins import Registry, load_registry
from cpdeform.core.simulator import Simulator
from cpdeform.core.state import State
from cpdeform.core.task import Task, merge
from cpdeform.planning.optimizer import TrajectoryOptimizer
from cpdeform.planning.pruner import PrunerHalving, PrunerNone
from cpdeform.planning.result import Observer
from cpdeform.planning.strategy import Strategy
from cpdeform.run.record_reader import RunRecord, load_record
from cpdeform.run.resolve import PartObjects, resolve
from cpdeform.run.result import RunResult


def deform(
    task: Task | str | None = None,
    *,
    simulator: Simulator | str | None = None,
    ot_solver: OTSolver | str | None = None,
    placer: Placer | str | None = None,
    strategy: Strategy | str | None = None,
    objective: Objective | None = None,
    optimizer: TrajectoryOptimizer | None = None,
    device: str | None = None,
    seed: int | None = None,
    stages: int | None = None,
    settings: Mapping[str, Any] | None = None,
    resume: RunRecord | str | Path | None = None,
    state: State | None = None,
    first_stage: int = 0,
    observers: Sequence[Observer] = (),
    registry: Registry | None = None,
) -> RunResult:
    """Plan how the tools of a task turn its body into its goal (paper, Algorithm 1).

    The same request gives the same result here and on the command line (``cpdeform run``); both come through
    `cpdeform.run.resolve.resolve`.

    Args:
        task: A task, a registered name, or the path of a YAML file; defaults to ``"writer"``. Not with `resume`.
        simulator: A simulator of the task's scene, or a registered name; defaults to ``"auto"``, the fastest one that is installed.
            The limits that a task puts on its tools count unless a simulator is given whose scene does not have them.
        ot_solver: A transport solver, a registered name, or ``"auto"``, the default; it gives the priorities and, unless
            `objective` is given, the loss.
        placer: A placer or a registered name; defaults to what the strategy sets, else ``"transport"``.
        strategy: A strategy or a registered name; defaults to ``"auto"``, what fits the task, see
            `cpdeform.run.strategy_choice.choose_strategy`.
        objective: The loss; defaults to what the settings describe. No refinement comes after a loss given as an object.
        optimizer: Finds actions; defaults to `TrajectoryOptimizer` with the strategy's settings. A refinement makes no more
            iterations than it.
        device: Where a simulator given by name runs, ``"cpu"`` (the default) or ``"cuda"``.
        seed: Seed of first actions and random placements; defaults to 0.
        stages: Number of stages; defaults to the task's own.
        settings: Any other field of `cpdeform.run.configuration.RunConfiguration`, nested, as ``--set`` takes them:
            ``{"optimizer": {"iterations": 30}, "scene": {"ground_friction": 2.0}}``.
        resume: A run record, or its directory, to go on from: its last state, task and settings, under those given.
        state: Where to start, a single world; defaults to the scene's start. Not with `resume`.
        first_stage: Number of the first stage, of a run that starts from a `state`.
        observers: Told of every iteration and stage, in order; the plugins' observers come after them.
        registry: Where names are looked up; defaults to the installed plugins.

    Returns:
        Stages, losses, metric and status; `RunResult.save` writes the run record.

    Raises:
        InputError: A name, an option or the task cannot be used.
        CapabilityError: The parts do not fit together.

    Example:
        Two iterations with few particles, so that it takes a moment:

        >>> few = {"scene": {"bodies": {"0": {"particle_count": 200}}}, "objective": {"points": 100}}
        >>> result = deform("writer", stages=1, settings={**few, "optimizer": {"iterations": 2}})
        >>> result.loss_final <= result.loss_initial
        True
        >>> result.save("runs/first").name
        'first'
    """
    named = {"backend": simulator, "ot": ot_solver, "placer": placer, "strategy": strategy}
    values: dict[str, Any] = {field: part for field, part in named.items() if isinstance(part, str)}
    plain = {"device": device, "seed": seed, "stages": stages, "task": task if isinstance(task, str) else None}
    values |= {field: value for field, value in plain.items() if value is not None}
    if type(optimizer) is TrajectoryOptimizer:
        options = {field.name: getattr(optimizer, field.name) for field in dataclasses.fields(optimizer)}
        # A pruner of another kind has no name that a record could keep.
        own = type(optimizer.pruner) in (PrunerHalving, PrunerNone)
        values["optimizer"] = {**options, "pruner": optimizer.pruner.name if own else PrunerHalving.name}
    objects = PartObjects(
        simulator=None if isinstance(simulator, str) else simulator,
        ot_solver=None if isinstance(ot_solver, str) else ot_solver,
        placer=None if isinstance(placer, str) else placer,
        strategy=None if isinstance(strategy, str) else strategy,
        objective=objective,
        optimizer=optimizer,
    )
    return resolve(
        merge(settings or {}, values),
        registry=registry or load_registry(),
        task=task if isinstance(task, Task) else None,
        record=load_record(resume) if isinstance(resume, (str, Path)) else resume,
        objects=objects,
        state=state,
        first_stage=first_stage,
    ).run(observers)
