"""An episode: a plan from the scene's start to the end of its last stage, as arrays for those who learn from it."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cpdeform.core.errors import InputError
from cpdeform.core.task import Task
from cpdeform.planning.metrics import goal_mass_grid
from cpdeform.planning.objectives.mass import mass_grid
from cpdeform.planning.objectives.metrics import soft_iou
from cpdeform.planning.result import StageResult
from cpdeform.run.record_reader import RunRecord

Array = NDArray[Any]
SUBSET_SEED = 0
"""Seed of the particles that are observed: the same for all episodes."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Episode:
    """T steps of S stages. Tools are put to another place where a stage begins; all else follows from the actions.

    Attributes:
        actions: Actions (T, A) in [-1, 1]; zero where the tools rest.
        placed: Steps (T,) before which the tools were put where `tool_poses` has them: the first one of each stage.
        tool_poses: Poses (T + 1, M, 8) of the tools at each time, after they were placed; position, quaternion wxyz, gap.
        particles: Positions (T + 1, K, 3) of the observed particles, length units.
        observed: Indices (K,) of these particles.
        rewards: What each step (T,) adds to the normalised incremental IoU with the goal; they sum to that of the end.
        success: Whether the state after each step (T,) is near enough to the goal.
        stage_starts: First step (S,) of each stage.
        priorities: Transport priorities (S, K) of the observed particles where a stage begins; nan where the placer needs none.
        losses: Loss (S + 1,) at the start and after each stage, units of the objective.
        goal: Goal particles (G, 3), length units.
        corresponds: Whether goal particle i is particle i of the clay, moved.
        final_positions: Positions (N, 3) of all particles at the end, length units.
    """

    actions: Array
    placed: Array
    tool_poses: Array
    particles: Array
    observed: Array
    rewards: Array
    success: Array
    stage_starts: Array
    priorities: Array
    losses: Array
    goal: Array
    corresponds: bool
    final_positions: Array

    @property
    def steps(self) -> int:
        """Number of steps T."""
        return len(self.actions)

    @property
    def succeeded(self) -> bool:
        """Whether the episode ends in a success."""
        return bool(self.success[-1])


def record_episode(record: RunRecord, *, particles: int, success_iou: float) -> Episode:
    """The episode of a recorded run.

    Args:
        record: A run from its start; stages without a plan do not count.
        particles: Particles to observe.
        success_iou: Normalised incremental IoU from which on a state is a success.

    Raises:
        InputError: The record has no stage with a plan.
    """
    stages = [stage for stage in record.stages if stage.status.executed]
    if not stages:
        raise InputError("run", came=f"one without a plan ({record.status})", expected="at least one stage with a plan")
    observed = _observed(stages[0].state.particle_count, particles)
    actions, poses, positions = (_joined(stages, name) for name in ("actions", "tool_poses", "positions"))
    lengths = [len(_plan(stage, "actions")) for stage in stages]
    starts = np.cumsum([0, *lengths[:-1]])
    placed = np.zeros(len(actions), dtype=bool)
    placed[starts] = True
    progress = _progress(record.task, positions, record.goal)
    return Episode(
        actions=actions.numpy(),
        placed=placed,
        tool_poses=poses.numpy(),
        particles=positions[:, observed].float().numpy(),
        observed=observed.numpy(),
        rewards=np.diff(progress),
        success=progress[1:] >= success_iou,
        stage_starts=starts,
        priorities=np.stack([stage.priorities[observed].numpy() for stage in stages]),
        losses=np.array([stages[0].loss_before, *(stage.loss for stage in stages)]),
        goal=np.asarray(record.task.load_goal()),
        corresponds=record.task.goal_corresponds(),
        final_positions=stages[-1].state.position[0].numpy(),
    )


def _observed(count: int, wanted: int) -> Tensor:
    """Indices of the particles that are observed, ascending."""
    order = torch.randperm(count, generator=torch.Generator().manual_seed(SUBSET_SEED))
    return order[:wanted].sort().values


def _plan(stage: StageResult, name: str) -> Tensor:
    found: Tensor = getattr(stage, name)
    return found.detach().cpu()


def _joined(stages: list[StageResult], name: str) -> Tensor:
    """An array of all stages one after the other; of times, each stage's last is the next one's first, tools placed."""
    parts = [_plan(stage, name) for stage in stages]
    if name != "actions":
        parts = [*(part[:-1] for part in parts[:-1]), parts[-1]]
    return torch.cat(parts)


def _progress(task: Task, positions: Tensor, goal: Tensor) -> Array:
    """Normalised increment (T + 1,) of the IoU with the goal, not clipped."""
    wanted = goal_mass_grid(task, goal.double())
    found = torch.stack([soft_iou(mass_grid(frame.double().clamp(0.0, 1.0), task.scene), wanted) for frame in positions])
    progress: Array = ((found - found[0]) / (soft_iou(wanted, wanted) - found[0])).numpy()
    return progress
