"""How much a stage may cost and how far a step may go, from the task's schedule and its tools' speed alone."""

from __future__ import annotations

from typing import Any

from cpdeform.core.task import Task

LARGEST_STEP = 0.2
"""Adam's largest step size, in units of action: it takes five iterations to go from rest to full speed."""

FIRST_MOVE = 0.05
"""How far the first iteration may move a tool, length units: two tools' radii, beyond which gradients tell nothing."""

LONG_STAGE = 20
"""Environment steps from which on a stage is long: tools first have to go to the clay, and many steps need many iterations."""


def learning_rate(task: Task) -> float:
    """Adam's step size with which the first iteration, equal steps in one direction, moves no tool by more than `FIRST_MOVE`."""
    speeds = [max(tool.action_scale[:3]) for tool in task.scene.tools if tool.movable]
    way = task.step_count * max(speeds, default=0.0)
    return LARGEST_STEP if way * LARGEST_STEP <= FIRST_MOVE else float(f"{FIRST_MOVE / way:.3g}")


def search_settings(task: Task) -> dict[str, Any]:
    """Settings of optimiser and loss that follow from the task.

    A task of several stages spends little on each of them, since the next one mends what is left. A task of a single stage has no
    second chance: it takes more iterations, and where the tools have a way to go, a term that draws them to the clay.
    """
    several, long = task.stage_count > 1, task.step_count >= LONG_STAGE
    iterations, patience = (24, 12) if several else (80, 20) if long else (40, 15)
    settings: dict[str, Any] = {"optimizer": {"iterations": iterations, "patience": patience, "learning_rate": learning_rate(task)}}
    if not several and long:
        settings["objective"] = {"contact_weight": 0.1}
    return settings
