"""A plan of a data set as a job: a goal is generated, a run reaches for it, and its episode is kept beside the record."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from cpdeform.core.plugins import Registry, load_registry
from cpdeform.core.task import changed_task, load_task, merge
from cpdeform.datasets.settings import DatasetSettings
from cpdeform.sweep.job import Job, JobContext
from cpdeform.sweep.job_run import figures, record_run
from cpdeform.sweep.queue import Queue, SweepHead

GOAL_FILE = "goal.npz"


def new_dataset(directory: Path, settings: DatasetSettings, *, registry: Registry) -> Queue:
    """Make the jobs of a data set, names and options checked; nothing is planned.

    Args:
        directory: Where; the data set of the same settings that is there already is taken as it is.
        settings: What to plan.
        registry: Where names are looked up.

    Raises:
        InputError: The scene, a name or an option cannot be used, or another data set is there.
    """
    from cpdeform.run.record_files import environment
    from cpdeform.run.resolve import resolve

    scene = str(Path(settings.scene).resolve()) if settings.scene.endswith((".yaml", ".yml")) else settings.scene
    values = merge(settings.settings, {"task": scene, "seed": settings.seed})
    configuration = resolve(values, registry=registry).configuration
    values |= {"backend": configuration.backend, "ot": configuration.ot}
    head = SweepHead(kind="dataset", threads=settings.threads, asked=dataclasses.asdict(settings), environment=environment())
    return Queue.create(directory, head, _jobs(settings.goals, values))


def _jobs(goals: Sequence[int], values: dict[str, Any]) -> list[Job]:
    return [
        Job(name=f"goal-{goal:06d}", record=f"records/goal-{goal:06d}", request={"goal": goal, "run": values}) for goal in goals
    ]


def do_plan(context: JobContext) -> dict[str, Any]:
    """Generate a goal and plan for it.

    Returns:
        Figures of the record, with the kind of the goal.
    """
    from cpdeform.run.resolve import resolve
    from cpdeform.tasks.generate.goal import generate_goal

    values, registry = dict(context.job.request["run"]), load_registry()
    # The goal of a seed is the same however often it is made.
    task = changed_task(load_task(values["task"], registry=registry), scene=values.get("scene", {}))
    goal = generate_goal(task, seed=context.job.request["goal"], registry=registry)
    goal.write(context.directory / GOAL_FILE)
    resolved = resolve({**values, "goal": str(context.directory / GOAL_FILE)}, registry=registry)
    record_run(resolved, context.directory, context.observers)
    return {"goal_kind": goal.kind, "goal_particles": len(goal.position), **figures(context.directory)}
