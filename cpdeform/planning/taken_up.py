"""Stages of a run that goes on, as if it had never been broken off."""

from __future__ import annotations

import dataclasses

from cpdeform.planning.algorithm import Planner, Start
from cpdeform.planning.result import StageResult


def taken_up(planner: Planner, start: Start) -> list[StageResult]:
    """The stages that a run goes on from and may revise; none where its parts or settings are others.

    Args:
        planner: The parts.
        start: Where the run goes on.

    Returns:
        The stages, their states (single worlds) and actions (T, A) on the simulator's device and of its type. Those at the end,
        from the last one with a plan on, tell again what the objective can start from.
    """
    if not start.continued:
        return []
    device, dtype, warm = planner.simulator.device, planner.simulator.dtype, planner.warm_at(start)
    last = max((number for number, stage in enumerate(start.previous) if stage.actions is not None), default=0)
    return [
        dataclasses.replace(
            stage,
            state=stage.state.to(device=device, dtype=dtype),
            state_before=stage.state_before.to(device=device, dtype=dtype),
            actions=None if stage.actions is None else stage.actions.to(device=device, dtype=dtype),
            warm=warm if number >= last else None,
        )
        for number, stage in enumerate(start.previous)
    ]
