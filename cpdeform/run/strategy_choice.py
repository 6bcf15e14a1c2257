"""Which strategy ``"auto"`` stands for."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from cpdeform.core.task import Task

TOUCHES, RACE = "sculpt", "cpdeform"
"""For tasks of several stages, and for those of one."""

TOUCH_PLACER = "touch"

NOT_OF_TOUCHES = ("optimizer", "refinement", "priorities")
"""Option groups that the first of them does not take: who gives them wants the other one."""


def choose_strategy(task: Task, given: Mapping[str, Any], *, race: bool = False) -> str:
    """The strategy for a task under what the user gives.

    A task of several stages is sculpted by touches. Where a stage is all there is, candidates race each other; so they do where the
    user gives a placer, or options of the optimizer, of the refinement or of the priorities, which touches have no use for.

    Args:
        task: The task.
        given: Fields of the configuration that are set.
        race: Whether a placer or an optimizer is given as an object.
    """
    placer = given.get("placer", TOUCH_PLACER)
    others = [name for name in NOT_OF_TOUCHES if given.get(name)]
    touches = task.stage_count > 1 and placer == TOUCH_PLACER and not others and not race
    return TOUCHES if touches else RACE
