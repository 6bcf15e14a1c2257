"""Make or verify the goal files: `python -m cpdeform.tasks.make_goals [TASKS...] [--check]`."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Annotated

import numpy as np
import torch
import typer
from numpy.typing import NDArray

from cpdeform.core.errors import UnknownNameError
from cpdeform.core.goal import POSITION_SCALE, load_goal, write_goal
from cpdeform.core.plugins import AUTO, Registry, load_registry
from cpdeform.core.simulator import Simulator
from cpdeform.core.task import Task, load_task
from cpdeform.tasks.multi_stage import MULTI_STAGE, Maker
from cpdeform.tasks.single_stage import SINGLE_STAGE

TOLERANCE = 2.0 / POSITION_SCALE
"""Coordinates that agree within it count as the same, length units: simulators differ in the order in which they add."""

SHARE = 0.999
"""Share of the coordinates that must agree: a particle at the edge of a tool's reach may go either way."""

MAKERS: Mapping[str, tuple[Maker, bool]] = {**MULTI_STAGE, **SINGLE_STAGE}


def chosen(names: list[str]) -> list[str]:
    """Tasks with variants, by their names or by the names without variants; all where none is given.

    Raises:
        UnknownNameError: A task has no maker here.
    """
    result = []
    for name in names:
        found = [key for key in MAKERS if name in (key, key.rpartition("-")[0])]
        if not found:
            raise UnknownNameError("goal of task", name, MAKERS)
        result += found
    return result or list(MAKERS)


def make(task: Task, *, backend: str, registry: Registry) -> NDArray[np.float64]:
    """Goal particles (N, 3), length units, of a task.

    Args:
        task: The task.
        backend: Registered name of a simulator that computes in float64.
        registry: Where the name is looked up.
    """

    def simulator() -> Simulator:
        created: Simulator = registry.create("simulator", backend, scene=task.scene, dtype=torch.float64)
        return created

    return MAKERS[task.name][0](task.scene, simulator)


def agreement(task: Task, position: NDArray[np.float64]) -> float:
    """Share of the coordinates at which the task's goal file agrees with these positions (N, 3)."""
    stored = load_goal(task.goal, scene=task.scene)
    if stored.shape != position.shape:
        return 0.0
    rounded = np.rint(position * POSITION_SCALE) / POSITION_SCALE
    return float((np.abs(stored - rounded) <= TOLERANCE + 1e-12).mean())


def main(
    tasks: Annotated[list[str] | None, typer.Argument(help="Names, e.g. airplane, writer or move-v2; defaults to all.")] = None,
    check: Annotated[bool, typer.Option("--check", help="Compare with the files that are there instead of writing.")] = False,
    backend: Annotated[str, typer.Option(help="Simulator to make them with; must compute in float64.")] = AUTO,
) -> None:
    """Make the goals of tasks and write them, or compare them with the files that are there."""
    registry = load_registry()
    backend = registry.resolve("simulator", backend, device="cpu")
    different = 0
    for name in chosen(tasks or []):
        start = time.perf_counter()
        task = load_task(name, registry=registry)
        position = make(task, backend=backend, registry=registry)
        if check:
            share = agreement(task, position)
            different += share < SHARE
            verdict = "agrees" if share >= SHARE else "DIFFERENT"
            text = f"{verdict}, {100.0 * share:.2f}% of the coordinates"
        else:
            task.goal.parent.mkdir(parents=True, exist_ok=True)
            write_goal(task.goal, position, corresponds=MAKERS[task.name][1])
            text = f"{len(position)} particles, {task.goal.stat().st_size} bytes"
        typer.echo(f"{task.goal.name}: {text}, {time.perf_counter() - start:.1f} s")
    raise typer.Exit(1 if different else 0)


if __name__ == "__main__":
    typer.run(main)
