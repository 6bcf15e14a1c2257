"""What a run will take, in time and memory, from what its parts say they cost and one short rollout that is measured."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable, Sequence

import torch

from cpdeform.core.memory import give_back
from cpdeform.core.memory_limit import check_memory
from cpdeform.planning.algorithm import Planner
from cpdeform.planning.effort import Effort, JointEffort
from cpdeform.planning.still import still_trajectory

MEASURED_STEPS = 2
"""Environment steps of the rollouts that are measured."""

MEASURED_WORLDS = 4
"""The most worlds of these rollouts."""

FASTER, SLOWER = 0.7, 1.6
"""How much less and more than in that measurement a step may take: tools may touch more clay, histories may not fit into memory and
be computed twice, worlds may share a processor better or worse, and transport starts from what it found before."""

LIBRARIES = 150_000_000
"""Bytes that libraries and results take while a run goes on, beyond rollouts and gradients."""


@dataclasses.dataclass(frozen=True)
class UnitCost:
    """Seconds of a world of the run's own length.

    Attributes:
        gradient: A loss with its gradient.
        rollout: A loss without.
        transport: A loss and a transport problem solved from scratch, as where a stage begins.
    """

    gradient: float
    rollout: float
    transport: float


@dataclasses.dataclass(frozen=True)
class RunEstimate:
    """What a run will take.

    Attributes:
        stages: Number of stages.
        effort: What a stage computes.
        joint: What is computed over several stages together.
        memory: Least and most memory of the process at its peak, bytes.
        unit: What was measured.
        workers: Processes that share the work of a stage.
    """

    stages: int
    effort: Effort
    joint: tuple[JointEffort, ...]
    memory: tuple[int, int]
    unit: UnitCost
    workers: int = 1

    @property
    def total(self) -> Effort:
        """What the run computes."""
        found = self.effort.scaled(self.stages, self.stages)
        for joint in self.joint:
            found += joint.effort
        return found

    @property
    def seconds(self) -> tuple[float, float]:
        """Least and most wall time, pictures left out."""
        bounds = [self._stage_bounds] * self.stages + [self._bounds(joint.effort) for joint in self.joint]
        return sum(least for least, _ in bounds), sum(most for _, most in bounds)

    @property
    def stage_seconds(self) -> float:
        """Wall time of a stage, in the middle (of the two bounds, the geometric one)."""
        return math.sqrt(math.prod(self._stage_bounds))

    @property
    def stage_gradients(self) -> float:
        """Gradients of a stage, in the middle; at least one."""
        return max(1.0, math.sqrt(max(1, self.effort.gradients[0]) * self.effort.gradients[1]))

    def joint_seconds(self, joint: JointEffort) -> float:
        """Wall time of a descent over stages together, in the middle."""
        return math.sqrt(math.prod(self._bounds(joint.effort)))

    @property
    def _stage_bounds(self) -> tuple[float, float]:
        least, most = self._bounds(self.effort, workers=self.workers)
        return least + FASTER * self.unit.transport, most + SLOWER * self.unit.transport

    def _bounds(self, effort: Effort, *, workers: int = 1) -> tuple[float, float]:
        """Least and most wall time of some work."""
        least, most = (
            (self.unit.gradient * effort.gradients[end] + self.unit.rollout * effort.rollouts[end]) / workers for end in (0, 1)
        )
        return FASTER * least, SLOWER * most


def stage_effort(planner: Planner) -> Effort:
    """What the phases of a stage compute, by what placer and phases say of themselves."""
    movable = sum(tool.movable for tool in planner.task.scene.tools)
    proposals, rounds = planner.placer.expected_proposals(movable)
    by_scope = {scope: Effort() for scope in ("round", "search", "plan")}
    for phase in planner.phases:
        candidates = {"round": proposals, "search": proposals * rounds, "plan": 1}[phase.scope]
        by_scope[phase.scope] += phase.effort(candidates)
    executed = Effort(rollouts=(1, 1))
    return by_scope["round"].scaled(1, rounds) + by_scope["search"] + executed + by_scope["plan"]


def memory_bounds(held: int, needed: int) -> tuple[int, int]:
    """Least and most bytes of the process at its peak.

    Args:
        held: Bytes that the process holds before.
        needed: Bytes that rollouts and gradients hold, see `largest_need`.
    """
    return held + int(0.8 * needed), held + int(1.2 * needed) + LIBRARIES


def largest_need(planner: Planner, *, worlds: int, joint: Sequence[JointEffort] = ()) -> int:
    """The most bytes that rollouts and gradients hold.

    Batches shrink as candidates are dropped, and fewer worlds may take more: where their whole history fits, it is kept.

    Args:
        planner: The run's parts.
        worlds: Worlds of the largest batch.
        joint: What is computed over several stages together, one world each.
    """
    simulator, steps = planner.simulator, planner.task.rollout_steps
    batches = max(simulator.memory_estimate(steps, worlds=count) for count in range(1, worlds + 1))
    return max(batches, max((effort.stages for effort in joint), default=0) * simulator.memory_estimate(steps, worlds=1))


def measure_unit(planner: Planner, *, worlds: int, clock: Callable[[], float] = time.perf_counter) -> UnitCost:
    """Measure a short rollout and its gradient in the run's own scene, after one that compiles what has to be compiled.

    Args:
        planner: The run's parts.
        worlds: Worlds to be measured together.
        clock: Tells seconds.

    Raises:
        InputError: There is not enough memory.
    """
    simulator, objective, task = planner.simulator, planner.objective, planner.task
    steps = min(MEASURED_STEPS, task.rollout_steps)
    check_memory(simulator, step_count=steps, worlds=worlds)
    state = simulator.initial_state(batch_size=worlds)
    actions = torch.zeros(worlds, steps, task.scene.action_size).to(state.position)
    forward = backward = loss = 0.0
    for _ in range(2):
        marks = [clock()]
        trajectory = simulator.rollout(state, actions)
        marks.append(clock())
        simulator.vjp(trajectory, torch.ones_like(trajectory.positions))
        marks.append(clock())
        forward, backward = marks[1] - marks[0], marks[2] - marks[1]
    still = still_trajectory(simulator.initial_state(batch_size=1), task.rollout_steps, scene=task.scene)
    warm, losses = None, []
    for _ in range(2):
        begin = clock()
        warm = objective.evaluate(still, warm).warm
        losses.append(clock() - begin)
    transport, loss = losses
    share = task.rollout_steps / steps / worlds
    return UnitCost(
        gradient=share * (forward + backward) + loss, rollout=share * forward + loss, transport=2.0 * max(transport, loss)
    )


def estimate_run(
    planner: Planner,
    *,
    stages: int | None = None,
    workers: int = 1,
    effort: Effort | None = None,
    joint: Sequence[JointEffort] = (),
) -> RunEstimate:
    """Estimate a run that is about to start.

    Args:
        planner: The run's parts.
        stages: Number of stages; defaults to the task's.
        workers: Processes that the work is spread over.
        effort: What a stage computes; defaults to what its phases say.
        joint: What is computed over several stages together.

    Raises:
        InputError: There is not enough memory.
    """
    import psutil

    effort = effort or stage_effort(planner)
    movable = sum(tool.movable for tool in planner.task.scene.tools)
    batch = max(1, min(planner.placer.expected_proposals(movable)[0], planner.simulator.batch_size))
    unit = measure_unit(planner, worlds=min(batch, MEASURED_WORLDS))
    needed = largest_need(planner, worlds=batch, joint=joint)
    # What the measurement has left behind is used again, and must not count twice.
    planner.simulator.release_memory()
    give_back()
    held = int(psutil.Process().memory_info().rss)
    return RunEstimate(
        stages=stages or planner.task.stage_count,
        effort=effort,
        joint=tuple(joint),
        memory=memory_bounds(held, needed),
        unit=unit,
        workers=workers,
    )
