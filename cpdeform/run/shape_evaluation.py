"""Shape figures of a recorded run, from rest to rest.

A slab that starts above the floor falls before it is touched, and clay that was just pushed still moves. So the start, the result
and the goal are let to rest first, tools away, in the same simulator for every method; the goal is put where it comes to rest, not
deformed. A goal in the air loses its height by that: judge tasks that carry clay through the air without rest.
"""

from __future__ import annotations

import dataclasses
import time
from typing import Any

import torch
from torch import Tensor

from cpdeform.core.errors import PluginError
from cpdeform.core.plugins import AUTO, Registry, load_registry
from cpdeform.core.scene import Scene
from cpdeform.core.simulator import Simulator
from cpdeform.core.state import State, initial_state
from cpdeform.planning.rest import Rest, SettledGoal, rest, rest_scene, rest_state, settle_goal
from cpdeform.planning.shape_metrics import GoalShape, ShapeFigures
from cpdeform.run.record_reader import RunRecord


@dataclasses.dataclass(frozen=True, kw_only=True)
class RestFigures:
    """How a cloud came to rest.

    Attributes:
        steps: Environment steps that it took.
        rests: Whether it came to rest.
        residual: Motion of the fastest particle in the last step, cells per environment step.
    """

    steps: int
    rests: bool
    residual: float


@dataclasses.dataclass(frozen=True, kw_only=True)
class ShapeEvaluation:
    """Shape figures of a run.

    Attributes:
        figures: The figures.
        simulator: Registered name of the simulator that clay rested in; None without rest, as are the following.
        goal_drop: How far the goal was moved down, length units.
        goal_self_iou: Volume IoU of the goal with itself, let go as clay; far below 1 for a goal that clay does not keep.
        start: Rest of the scene's start.
        final: Rest of the result.
        goal: Rest of the goal, let go as clay.
        seconds: Wall time.
    """

    figures: ShapeFigures
    simulator: str | None = None
    goal_drop: float | None = None
    goal_self_iou: float | None = None
    start: RestFigures | None = None
    final: RestFigures | None = None
    goal: RestFigures | None = None
    seconds: float = 0.0

    def as_dict(self) -> dict[str, Any]:
        """All figures in one mapping: those of `ShapeFigures` by their names, the rests under ``"shape_rest"``."""
        rests = {name: getattr(self, name) for name in ("start", "final", "goal")}
        return {
            **dataclasses.asdict(self.figures),
            "shape_from_rest": self.simulator is not None,
            "shape_simulator": self.simulator,
            "goal_drop": self.goal_drop,
            "goal_self_iou": self.goal_self_iou,
            "shape_rest": {name: None if value is None else dataclasses.asdict(value) for name, value in rests.items()},
            "shape_seconds": self.seconds,
        }


def evaluate_shape(
    scene: Scene,
    *,
    start: State | None = None,
    final: State,
    goal: Tensor,
    from_rest: bool = True,
    backend: str = AUTO,
    registry: Registry | None = None,
) -> ShapeEvaluation:
    """Compute the shape figures of a result.

    Args:
        scene: The scene.
        start: What the result began from, a single world; defaults to the scene's start.
        final: The result, a single world.
        goal: Goal particles (M, 3), length units.
        from_rest: Whether to let all three come to rest first.
        backend: Registered name of the simulator that they rest in; ``"auto"`` is the fastest that is installed for the CPU.
        registry: Where the name is looked up; defaults to the installed plugins.

    Raises:
        InputError: The states or the goal do not fit the scene.
        PluginError: There is no simulator to rest in.
    """
    began = time.perf_counter()
    start = start or initial_state(scene)
    goal, clouds = goal.detach().cpu().double(), [state.position[0].detach().cpu() for state in (start, final)]
    data: dict[str, Any] = {}
    if from_rest:
        registry = registry or load_registry()
        data["simulator"] = _resolved(registry, backend)
        simulator = _simulator(registry, data["simulator"], rest_scene(scene))
        rests = [rest(simulator, rest_state(state.to(device="cpu"), scene)) for state in (start, final)]
        clouds = [item.state.position[0] for item in rests]
        data["start"], data["final"] = (_rest_figures(item) for item in rests)
        if len(goal) != scene.particle_count:
            simulator = _simulator(registry, data["simulator"], rest_scene(scene, particle_count=len(goal)))
        settled = settle_goal(simulator, goal)
        goal = settled.position
        data |= {"goal": _rest_figures(settled), "goal_drop": settled.drop, "goal_self_iou": settled.self_iou}
    shape = GoalShape(goal, scene, sample_size=len(clouds[1]))
    figures = shape.figures(start=clouds[0], final=clouds[1])
    return ShapeEvaluation(figures=figures, seconds=time.perf_counter() - began, **data)


def evaluate_shape_record(record: RunRecord, **options: Any) -> ShapeEvaluation:
    """Compute the shape figures of a recorded run: its last complete stage against the scene's start and the record's own goal.

    Args:
        record: The run.
        options: As for `evaluate_shape`, e.g. ``from_rest=False``.

    Raises:
        InputError: No stage of the run is complete.
        PluginError: There is no simulator to rest in.
    """
    return evaluate_shape(record.task.scene, final=record.state, goal=record.goal, **options)


def _resolved(registry: Registry, backend: str) -> str:
    try:
        return registry.resolve("simulator", backend, device="cpu")
    except PluginError as error:
        raise PluginError(f"{error} Without a simulator, judge the shape as it is, not at rest.") from error


def _simulator(registry: Registry, name: str, scene: Scene) -> Simulator:
    made: Simulator = registry.create("simulator", name, scene=scene, dtype=torch.float32)
    return made


def _rest_figures(found: Rest | SettledGoal) -> RestFigures:
    if isinstance(found, SettledGoal):
        return RestFigures(steps=found.steps, rests=found.rests, residual=found.residual)
    return RestFigures(steps=found.steps[0], rests=found.rests[0], residual=found.residual[0])
