"""Rollouts of many worlds, as many at a time as the simulator holds, with loss and gradient or with the loss alone."""

from __future__ import annotations

import contextlib
import dataclasses
import math
import time
from collections.abc import Sequence

import torch
from torch import Tensor

from cpdeform.core.memory import MemoryGauge, MemoryUse
from cpdeform.core.objective import Objective
from cpdeform.core.simulator import Simulator, Trajectory
from cpdeform.core.state import State
from cpdeform.planning.executor import Executor

Warm = list[object | None]
"""What an objective can start from in each world; None where a world has nothing."""


@dataclasses.dataclass(frozen=True)
class Batch:
    """Worlds that are simulated at once.

    Attributes:
        state: Start of b worlds.
        actions: Actions (b, T, A).
        warm: What the objective can start from, b entries, or None to evaluate from scratch.
        stand_ins: Final positions (b, N, 3) that the objective is asked about where a world's rollout is not finite.
        measured: Whether to measure the memory.
    """

    state: State
    actions: Tensor
    warm: tuple[object, ...] | None
    stand_ins: Tensor
    measured: bool = False


@dataclasses.dataclass(frozen=True)
class Evaluation:
    """What a batch came to.

    Attributes:
        loss: Loss (b,) in float64 on the CPU, objective units; nan where the rollout was not finite.
        gradient: Gradient (b, T, A) of the actions; None where it was not asked for.
        actions: The actions (b, T, A) that were executed; a simulator may tell others than it was asked for, see
            `cpdeform.planning.placed.SimulatorPlaced`.
        ends: The particles' final positions (b, N, 3).
        warm: What the objective can start from next time, b entries, or None.
        seconds: Wall time of the parts `rollout`, `objective` and `vjp`.
        memory: Memory of rollout and gradient, where it was measured.
    """

    loss: Tensor
    gradient: Tensor | None
    actions: Tensor
    ends: Tensor
    warm: tuple[object, ...] | None
    seconds: dict[str, float]
    memory: MemoryUse | None = None


@dataclasses.dataclass(frozen=True)
class Evaluator:
    """Computes batches; an `Executor` may take it elsewhere.

    Attributes:
        simulator: Physics.
        objective: The loss.
        with_gradient: Whether the gradient is computed, too.
    """

    simulator: Simulator
    objective: Objective
    with_gradient: bool = True

    def __call__(self, batch: Batch) -> Evaluation:
        """Roll out, take the loss and, if asked for, the gradient."""
        gauge = _gauge(self.simulator) if batch.measured else None
        marks = [time.perf_counter()]
        run = self.simulator.rollout if self.with_gradient else self.simulator.simulate
        trajectory = run(batch.state, batch.actions)
        finite = torch.isfinite(trajectory.positions).flatten(1).all(dim=1)
        marks.append(time.perf_counter())
        # The gauge leaves out the objective, whose memory no estimate covers.
        with contextlib.nullcontext() if gauge is None else gauge.leave_out():
            asked = trajectory if bool(finite.all()) else _held(trajectory, batch.stand_ins, finite)
            result = self.objective.evaluate(asked, batch.warm) if self.with_gradient else None
            found = self.objective.losses(asked, batch.warm) if result is None else result.loss
        marks.append(time.perf_counter())
        gradient = None
        if result is not None:
            gradient = self.simulator.vjp(trajectory, result.grad_positions, result.grad_tools).actions
        marks.append(time.perf_counter())
        loss = torch.where(finite, found.detach().double(), torch.nan).cpu()
        ends = trajectory.positions[:, -1].detach().clone()
        seconds = {name: marks[i + 1] - marks[i] for i, name in enumerate(("rollout", "objective", "vjp"))}
        warm = None if result is None else result.warm
        return Evaluation(loss, gradient, trajectory.actions, ends, warm, seconds, self._memory(batch, gauge))

    def _memory(self, batch: Batch, gauge: MemoryGauge | None) -> MemoryUse | None:
        if gauge is None:
            return None
        worlds, steps = batch.actions.shape[:2]
        estimate = self.simulator.memory_estimate(steps, worlds=worlds)
        return MemoryUse(worlds, estimate, gauge.peak() if gauge.exact else None)


def evaluate_worlds(
    evaluator: Evaluator,
    executor: Executor,
    state: State,
    actions: Tensor,
    *,
    warm: Sequence[object | None],
    stand_ins: Tensor,
    measured: bool = False,
) -> Evaluation:
    """Evaluate any number of worlds in batches that the simulator holds.

    Args:
        evaluator: Computes a batch.
        executor: Where the batches are computed.
        state: Start of B worlds, or a single world that they all share but for the tools' poses.
        actions: Actions (B, T, A).
        warm: What the objective can start from in each world, B entries.
        stand_ins: Final positions (B, N, 3) to be used where a rollout is not finite.
        measured: Whether to measure the memory of the first batch.

    Returns:
        The evaluation of all worlds; wall times are sums over the batches.
    """
    batches, size = [], min(evaluator.simulator.batch_size, math.ceil(len(actions) / executor.width))
    for start in range(0, len(actions), size):
        part = slice(start, start + size)
        entries = tuple(entry for entry in warm[part] if entry is not None)
        ready = entries if len(entries) == len(actions[part]) else None
        worlds = state if len(actions) <= size else _part(state, part)
        batches.append(Batch(worlds, actions[part], ready, stand_ins[part], measured and start == 0))
    found = executor.map(evaluator, batches)
    if len(found) == 1:
        return found[0]
    gradients = [item.gradient for item in found if item.gradient is not None]
    warms = [entry for item in found for entry in item.warm or ()]
    return Evaluation(
        loss=torch.cat([item.loss for item in found]),
        gradient=torch.cat(gradients) if gradients else None,
        actions=torch.cat([item.actions for item in found]),
        ends=torch.cat([item.ends for item in found]),
        warm=tuple(warms) if len(warms) == len(actions) else None,
        seconds={name: sum(item.seconds[name] for item in found) for name in found[0].seconds},
        memory=found[0].memory,
    )


def _part(state: State, part: slice) -> State:
    return state.map(lambda tensor: tensor[part])


def _gauge(simulator: Simulator) -> MemoryGauge:
    simulator.release_memory()
    return MemoryGauge(simulator.device)


def _held(trajectory: Trajectory, stand_ins: Tensor, finite: Tensor) -> Trajectory:
    """The trajectory with worlds that broke held where their best plan ends: an objective cannot be asked about nan.

    They go on from that plan, and so does what the objective can start from next time.
    """
    held = stand_ins.unsqueeze(1).expand_as(trajectory.positions)
    positions = torch.where(finite[:, None, None, None], trajectory.positions, held)
    return dataclasses.replace(trajectory, positions=positions, tool_poses=trajectory.tool_poses.nan_to_num())
