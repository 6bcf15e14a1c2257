"""Recorded runs made again: their plans in the same or another simulator, and their figures computed anew."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Iterator

import torch
from torch import Tensor

from cpdeform.core.objective import Objective
from cpdeform.core.plugins import Registry, load_registry
from cpdeform.core.sampling import sample_particles
from cpdeform.core.simulator import Simulator, Trajectory
from cpdeform.core.state import State
from cpdeform.planning.metrics import evaluate_metric
from cpdeform.planning.result import StageResult
from cpdeform.planning.still import still_trajectory
from cpdeform.planning.strategy import Strategy
from cpdeform.run.parts import make_objective
from cpdeform.run.record_reader import RunRecord
from cpdeform.run.replay import recorded_simulator, replay_stage
from cpdeform.run.resume import recorded_configuration

EXACT = 1e-9
"""Relative difference that numbers written as text and read again may have."""

LOSS_TOLERANCE = 0.02
"""Relative difference of a loss: recorded ones may come from a warm start, and sums depend on the number of threads."""

POSITION_TOLERANCE = 1e-3
"""Mean distance between particles of two rollouts of a plan that count as the same, length units."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class StageDifference:
    """How far the clay of a replayed stage ends from the recorded one; distances between particles, length units.

    Attributes:
        stage: Number of the stage.
        mean: Mean distance, replayed from the state that the record has for the stage's beginning.
        largest: Largest distance.
        chained_mean: Mean distance where each stage goes on from where the replay of the one before ended.
        chained_largest: Largest distance then.
    """

    stage: int
    mean: float
    largest: float
    chained_mean: float
    chained_largest: float


def replay_record(record: RunRecord, simulator: Simulator) -> Iterator[StageDifference]:
    """Repeat the plans of a recorded run, stage by stage.

    Args:
        record: The run.
        simulator: Of the record's scene, see `cpdeform.run.replay.recorded_simulator`.
    """
    state: State | None = None
    for stage in record.stages:
        if not stage.status.executed:
            continue
        alone = replay_stage(simulator, stage).final_state
        # The first stage has begun where the record says: chained and alone are the same.
        chained = alone if state is None else replay_stage(simulator, stage, state=state).final_state
        state = chained
        mean, largest = _distances(alone.position[0], stage.state.position[0])
        chained_mean, chained_largest = _distances(chained.position[0], stage.state.position[0])
        yield StageDifference(
            stage=stage.index, mean=mean, largest=largest, chained_mean=chained_mean, chained_largest=chained_largest
        )


@dataclasses.dataclass(frozen=True)
class Check:
    """A figure of a record, and what it is when it is computed again.

    Attributes:
        name: What it is.
        recorded: What the record says.
        found: What it is.
        tolerance: How far they may differ, relative to the recorded one, or absolute where that is 0.
    """

    name: str
    recorded: float
    found: float
    tolerance: float

    @property
    def holds(self) -> bool:
        """Whether they agree; two numbers that are both unknown do."""
        if math.isnan(self.recorded) or math.isnan(self.found):
            return math.isnan(self.recorded) and math.isnan(self.found)
        return abs(self.found - self.recorded) <= self.tolerance * (abs(self.recorded) or 1.0)


def verify_record(record: RunRecord, *, backend: str | None = None, registry: Registry | None = None) -> Iterator[Check]:
    """Compute the figures of a recorded run again.

    Sums, choices and the way from stage to stage come first, from the record alone; then every executed plan is rolled out and its
    loss taken anew; last the task's metric. Losses are left out where the record has no configuration, as one made in Python may:
    what they measure is not known.

    Args:
        record: The run.
        backend: Registered name of the simulator; defaults to the record's own.
        registry: Where names are looked up; defaults to the installed plugins.

    Raises:
        InputError: No stage is complete, or the record's configuration cannot be used.
        PluginError: The simulator or the transport solver is not installed.
    """
    registry = registry or load_registry()
    yield from _sums(record)
    simulator = recorded_simulator(record, backend=backend, registry=registry)
    configuration = recorded_configuration(record)
    objective = None
    if record.run.get("configuration") is not None:
        objective = make_objective(record.task, configuration.ot, simulator, options=configuration.objective, registry=registry)
        if configuration.strategy in registry.names("strategy"):
            strategy: Strategy = registry.create("strategy", configuration.strategy, **configuration.strategy_options)
            goal = record.goal.to(device=simulator.device, dtype=simulator.dtype)
            objective = strategy.objective(objective, simulator=simulator, goal=goal)
    for stage in record.stages:
        yield from _stage_checks(record, stage, simulator, objective)
    start = torch.as_tensor(sample_particles(record.task.scene))
    final = record.state.position[0]
    metric = evaluate_metric(record.task, start=start.to(final), final=final, goal=record.goal.to(final), registry=registry)
    if record.run.get("metric_value") is not None:
        yield Check(f"{record.run['metric']} at the start", _number(record.run["metric_initial"]), metric.initial, LOSS_TOLERANCE)
        yield Check(f"{record.run['metric']} at the end", _number(record.run["metric_value"]), metric.final, LOSS_TOLERANCE)


def _sums(record: RunRecord) -> Iterator[Check]:
    """Figures that follow from others of the record."""
    run, stages = record.run, record.stages
    yield Check("finished stages", float(run.get("stages_finished", 0)), float(record.finished_stages), EXACT)
    parts: dict[str, Callable[[], float]] = {
        "loss_initial": lambda: stages[0].loss_before,
        "loss_final": lambda: stages[-1].loss,
        "gradient_evaluations": lambda: float(sum(stage.gradient_evaluations for stage in stages)),
        "rollouts": lambda: float(sum(stage.rollouts for stage in stages)),
    }
    for name, made in parts.items():
        if stages and run.get(name) is not None:
            yield Check(name.replace("_", " "), _number(run[name]), made(), EXACT)
    for before, after in itertools.pairwise(stages):
        name = f"stage {after.index + 1}: distance of its beginning from the end of stage {before.index + 1}"
        yield Check(name, 0.0, _distances(before.state.position[0], after.state_before.position[0])[1], EXACT)


def _stage_checks(record: RunRecord, stage: StageResult, simulator: Simulator, objective: Objective | None) -> Iterator[Check]:
    """The losses of a stage, and where its plan leads."""
    label = f"stage {stage.index + 1}"
    begin = stage.state_before.to(device=simulator.device, dtype=simulator.dtype)
    if objective is not None:
        still = objective.losses(still_trajectory(begin, record.task.rollout_steps, scene=record.task.scene))
        yield Check(f"{label}: loss before", stage.loss_before, float(still[0]), LOSS_TOLERANCE)
    if not stage.status.executed or stage.positions is None:
        return
    replay = replay_stage(simulator, stage)
    name = f"{label}: mean distance of the replayed clay from the recorded one"
    yield Check(name, 0.0, _distances(replay.positions[0, -1], stage.positions[-1])[0], POSITION_TOLERANCE)
    if objective is not None:
        found = _loss(objective, stage, replay.positions, replay.tool_poses, begin)
        yield Check(f"{label}: loss", stage.loss, found, LOSS_TOLERANCE)


def _loss(objective: Objective, stage: StageResult, positions: Tensor, poses: Tensor, begin: State) -> float:
    assert stage.actions is not None
    end = stage.state.to(device=begin.position.device, dtype=begin.position.dtype)
    trajectory = Trajectory(
        positions.to(begin.position), poses.to(begin.position), stage.actions[None].to(begin.position), begin, end
    )
    return float(objective.losses(trajectory)[0])


def _distances(first: Tensor, second: Tensor) -> tuple[float, float]:
    """Mean and largest distance between particles (N, 3), length units."""
    distance = (first.detach().cpu().double() - second.detach().cpu().double()).norm(dim=1)
    return float(distance.mean()), float(distance.max())


def _number(value: float | None) -> float:
    """A number of a record, where null is one that was not finite."""
    return math.nan if value is None else float(value)
