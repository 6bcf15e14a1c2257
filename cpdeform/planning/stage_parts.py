"""What a stage begins with, besides the clay, and what it came to: random numbers, contacts that failed, status, result."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from cpdeform.core.placer import LEAST_GAIN, Candidate
from cpdeform.planning.interrupted import Execution
from cpdeform.planning.result import StageResult, Status
from cpdeform.planning.workbench import Workbench


def stage_generator(seed: int, index: int) -> torch.Generator:
    """Random numbers of the stage with the given number; they depend on nothing that happened before it."""
    if index > 0:
        seed = int(np.random.SeedSequence([seed, index]).generate_state(1)[0])
    return torch.Generator().manual_seed(seed)


def failed_contacts(stages: Sequence[StageResult]) -> tuple[int, ...]:
    """Contact particles of the candidates of all stages since the last one that gained at least `LEAST_GAIN`.

    Those of an interrupted stage are not among them, since they had no chance to show what they gain.
    """
    found: list[int] = []
    for stage in reversed(stages):
        if stage.loss < (1.0 - LEAST_GAIN) * stage.loss_before:
            break
        if stage.status is Status.INTERRUPTED:
            continue
        contacts = [candidate.proposal.contact_particle for candidate in stage.candidates]
        found += [contact for contact in contacts if contact is not None]
    return tuple(dict.fromkeys(found))


def search_status(candidates: Sequence[Candidate], best: int | None, loss_before: float) -> Status:
    """What the search of a stage came to: whether its best candidate is better than the loss that there was."""
    if best is None:
        return Status.NO_PLACEMENT
    if candidates[best].loss < loss_before:
        return Status.FINISHED
    return Status.NO_IMPROVEMENT if any(candidate.finite for candidate in candidates) else Status.NON_FINITE


def stage_result(
    bench: Workbench, candidates: list[Candidate], best: int | None, status: Status, execution: Execution
) -> StageResult:
    """What a stage came to; without an executed plan its state is the one before."""
    trajectory, state = execution.trajectory, bench.stage.state
    bench.seconds["total"] = bench.total()
    return StageResult(
        index=bench.stage.index,
        status=status,
        state_before=state,
        state=state if trajectory is None else trajectory.final_state,
        priorities=bench.stage.priorities,
        candidates=tuple(candidates),
        best=None if trajectory is None else best,
        actions=None if trajectory is None else trajectory.actions[0],
        positions=None if trajectory is None else trajectory.positions[0],
        tool_poses=None if trajectory is None else trajectory.tool_poses[0],
        loss_before=bench.stage.loss,
        loss=execution.loss,
        gradient_evaluations=bench.gradient_evaluations,
        rollouts=bench.rollouts,
        history=tuple(bench.history),
        seconds=bench.seconds,
        warm=execution.warm,
    )
