"""Rollouts of recorded plans: the executed one, or one that lost, in the recorded simulator or in another one."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from cpdeform.core.plugins import Registry, load_registry
from cpdeform.core.simulator import Simulator
from cpdeform.core.state import State
from cpdeform.planning.result import StageResult
from cpdeform.run.record_reader import RunRecord
from cpdeform.run.resume import recorded_configuration


def recorded_simulator(
    record: RunRecord, *, backend: str | None = None, device: str | None = None, worlds: int = 1, registry: Registry | None = None
) -> Simulator:
    """Make the simulator of a run, or another one of the same scene.

    Args:
        record: The run.
        backend: Registered name; defaults to the record's own, with its options. Another one gets its own defaults.
        device: ``"cpu"`` or ``"cuda"``; defaults to the record's.
        worlds: The most worlds of a batch.
        registry: Where the name is looked up; defaults to the installed plugins.

    Raises:
        InputError: The record's configuration cannot be used, or the name is unknown.
        PluginError: Nothing is installed that ``"auto"`` could stand for.
        MissingExtraError: What the simulator needs is not installed.
    """
    registry = registry or load_registry()
    configuration = recorded_configuration(record)
    device = device or configuration.device
    name = registry.resolve("simulator", backend or configuration.backend, device=device)
    options: dict[str, Any] = dict(configuration.simulator_options) if name == configuration.backend else {}
    made: Simulator = registry.create(
        "simulator", name, scene=record.task.scene, device=device, **{**options, "batch_size": worlds}
    )
    return made


@dataclasses.dataclass(frozen=True)
class Replay:
    """What plans do from the state that their stage began with.

    Attributes:
        positions: Particle positions (B, T+1, N, 3), length units, on the CPU.
        tool_poses: Tool poses (B, T+1, M, 8), on the CPU.
        final_state: State of B worlds after the last step, on the CPU.
    """

    positions: Tensor
    tool_poses: Tensor
    final_state: State


def replay_candidates(simulator: Simulator, stage: StageResult, candidates: Sequence[int]) -> Replay:
    """Roll candidates of a recorded stage out, all in one batch.

    Args:
        simulator: Holds as many worlds.
        stage: The stage.
        candidates: Numbers of the candidates in the stage, at least one.
    """
    chosen = [stage.candidates[number] for number in candidates]
    state = stage.state_before.to(device=simulator.device, dtype=simulator.dtype).fork(len(chosen))
    poses = torch.stack([candidate.proposal.pose for candidate in chosen]).to(state.position)
    actions = torch.stack([candidate.actions for candidate in chosen]).to(state.position)
    return _rollout(simulator, state.with_tools(poses), actions)


def replay_stage(simulator: Simulator, stage: StageResult, *, state: State | None = None) -> Replay:
    """Roll the executed plan of a stage out.

    Args:
        simulator: Of the record's scene.
        stage: A stage whose plan was executed.
        state: Where to start, a single world; defaults to the recorded state. The tools are placed as recorded.
    """
    assert stage.actions is not None
    assert stage.tool_poses is not None
    start = (state or stage.state_before).to(device=simulator.device, dtype=simulator.dtype)
    start = start.with_tools(stage.tool_poses[:1].to(start.position))
    return _rollout(simulator, start, stage.actions.unsqueeze(0).to(start.position))


def _rollout(simulator: Simulator, state: State, actions: Tensor) -> Replay:
    trajectory = simulator.rollout(state, actions)
    positions, poses = (tensor.detach().cpu() for tensor in (trajectory.positions, trajectory.tool_poses))
    return Replay(positions, poses, trajectory.final_state.map(lambda tensor: tensor.detach().cpu()))
