"""Algorithm 1 of the paper: contact points discovery, then gradient descent, stage by stage [1]_.

The lines quoted in the comments are those of the algorithm.

References:
    .. [1] Li, Huang, Du, Su, Tenenbaum, Gan, "Contact Points Discovery for Soft-Body Manipulations with Differentiable
       Physics", ICLR 2022, Algorithm 1.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterable, Sequence

import numpy as np
import torch
from torch import Tensor

from cpdeform.core.bounded import MOST_COUNT, MOST_SEED, MOST_STAGES
from cpdeform.core.errors import CapabilityError, InputError
from cpdeform.core.memory_limit import check_memory
from cpdeform.core.metrics import evaluate_metric
from cpdeform.core.objective import Objective
from cpdeform.core.optimizer import Iteration, OptimizationResult, TrajectoryOptimizer
from cpdeform.core.options import whole_number
from cpdeform.core.ot import OTSolver
from cpdeform.core.placer import LEAST_GAIN, Placement, PlacementResult, Placer, Stage
from cpdeform.core.priorities import PriorityKind, transport_displacements, transport_priorities
from cpdeform.core.refinement import Refinement, gained
from cpdeform.core.result import DeformResult, Observer, StageResult, Status
from cpdeform.core.scene import Scene
from cpdeform.core.signed_distance import signed_distance
from cpdeform.core.simulator import Simulator, Trajectory
from cpdeform.core.state import State
from cpdeform.core.task import Task

MAX_START_DEPTH = 1e-3
"""How deep a particle may lie inside a tool at the scene's start, length units."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Planner:
    """The parts of Algorithm 1, put together; any part may be replaced.

    Attributes:
        task: Scene, goal and schedule.
        simulator: Differentiable physics.
        ot_solver: Gives the transport priorities.
        placer: Turns priorities into candidate placements.
        objective: The shape loss.
        optimizer: Finds actions.
        priority_kind: What the priorities are; see `transport_priorities`.
        refinement: Goes on from each stage's best plan before it is executed; not part of Algorithm 1.
        seed: Seed of first actions and random placements.
        observers: Told of every iteration and stage.
        names: Names of the parts for the record.
    """

    task: Task
    simulator: Simulator
    ot_solver: OTSolver
    placer: Placer
    objective: Objective
    optimizer: TrajectoryOptimizer
    priority_kind: PriorityKind = "potential"
    refinement: Refinement | None = None
    seed: int = 0
    observers: tuple[Observer, ...] = ()
    names: dict[str, str] = dataclasses.field(default_factory=dict)

    def run(
        self,
        *,
        stages: int | None = None,
        state: State | None = None,
        first_stage: int = 0,
        previous: Sequence[StageResult] = (),
    ) -> DeformResult:
        """Run Algorithm 1.

        Args:
            stages: Number of stages; the task's own where absent.
            state: Where to start, a single world, e.g. the last state of a run record; the scene's start where absent.
            first_stage: Number of the first stage: of one that goes on from a record, `RunRecord.next_stage`. With the seed it
                determines the random numbers, so that a run that is resumed equals one that went through.
            previous: The stages before the first one, of a run that goes on: contact points that failed there are not tried again.

        Returns:
            Every stage, and how the run ended. A stage that fails ends the run; what came before is kept.

        Raises:
            CapabilityError: The parts do not fit together.
            InputError: `stages` or `first_stage` is out of range, the goal or `state` cannot be used, a tool starts inside the
                body, or there is not enough memory.
        """
        count = self.task.stage_count if stages is None else stages
        count = whole_number("stages", count, least=1, most=MOST_STAGES)
        first_stage = whole_number("first_stage", first_stage, least=0, most=MOST_COUNT)
        whole_number("seed", self.seed, least=0, most=MOST_SEED)
        self._check()
        check_memory(self.simulator, step_count=self.task.rollout_steps, worlds=1)
        scene_start = self.simulator.initial_state(batch_size=1)
        check_tools_outside(self.task.scene, scene_start)
        state = scene_start if state is None else self._check_state(state)
        start = time.perf_counter()
        target = torch.as_tensor(self.task.load_target()).to(device=self.simulator.device, dtype=self.simulator.dtype)
        for observer in self.observers:
            observer.run_started(self.task, target, self.names, self.seed)
        results: list[StageResult] = []
        # "for each stage:"
        for index in range(first_stage, first_stage + count):
            failed = failed_contacts([*previous, *results])
            result = self._stage(index, state, target, stage_generator(self.seed, index), failed)
            results.append(result)
            for observer in self.observers:
                observer.stage_finished(result)
            if result.status is not Status.FINISHED:
                break
            state = result.state
        metric = evaluate_metric(self.task, start=scene_start.position[0], final=state.position[0], target=target)
        finished = DeformResult(
            task=self.task,
            target=target,
            stages=tuple(results),
            status=results[-1].status,
            loss_initial=results[0].loss_before,
            loss_final=results[-1].loss,
            metric_name=self.task.metric,
            metric_initial=metric.initial,
            metric_value=metric.final,
            gradient_evaluations=sum(result.gradient_evaluations for result in results),
            seconds=time.perf_counter() - start,
            names=self.names,
            seed=self.seed,
        )
        for observer in self.observers:
            observer.run_finished(finished)
        return finished

    def _check(self) -> None:
        """Hold the parts against each other's declared capabilities before any work is done."""
        if not self.simulator.capabilities.differentiable:
            raise CapabilityError(f"{type(self.simulator).__name__} has no gradient; choose a differentiable simulator.")
        placing, transport = self.placer.capabilities, self.ot_solver.capabilities
        if placing.needs_priorities and self.priority_kind == "potential" and transport.potentials != "entropic":
            raise CapabilityError(
                f"{type(self.ot_solver).__name__} gives exact dual potentials, which are no transport priorities: where the shapes "
                "agree they are arbitrary. Choose a solver with entropic potentials, such as pot or geomloss."
            )
        movable = sum(manipulator.movable for manipulator in self.task.scene.manipulators)
        if movable == 0:
            raise InputError("scene.manipulators", came="no movable tool", expected="at least one with a positive action_scale")
        if placing.max_manipulators is not None and movable > placing.max_manipulators:
            raise CapabilityError(
                f"{type(self.placer).__name__} places at most {placing.max_manipulators} movable tools, the scene has {movable}; "
                "use the placer fixed."
            )
        if self.simulator.scene != self.task.scene:
            raise InputError("simulator", came="a simulator of another scene", expected="one built from task.scene")

    def _check_state(self, state: State) -> State:
        """Move a given start to the simulator's device and type."""
        state = state.to(device=self.simulator.device, dtype=self.simulator.dtype)
        if state.batch_size != 1:
            raise InputError("state", came=f"{state.batch_size} worlds", expected="a single world")
        actions = torch.zeros(1, self.task.rollout_steps, self.task.scene.action_size)
        self.simulator.check_inputs(state, actions)
        return state

    def _stage(self, index: int, state: State, target: Tensor, generator: torch.Generator, failed: tuple[int, ...]) -> StageResult:
        """One stage: priorities, placements, plans, execution of the best."""
        seconds: dict[str, float] = {}
        clock = _Clock(seconds)
        still = still_trajectory(state, self.task.rollout_steps, scene=self.task.scene)
        loss_before = float(self.objective.begin(still).loss[0])
        # "priorities f = optimal-transport potentials between current shape S_i and goal G"
        priorities, displacements = torch.full_like(state.position[0, :, 0], torch.nan), None
        if self.placer.capabilities.needs_priorities:
            transport = self.ot_solver.solve(state.position[0], target)
            priorities = transport_priorities(transport, kind=self.priority_kind)
            displacements = transport_displacements(transport) if self.priority_kind == "displacement" else None
        clock.lap("transport")
        stage = Stage(index, self.task.scene, state, target, priorities, generator, loss_before, failed, displacements)
        candidates: list[PlacementResult] = []
        history: list[Iteration] = []
        evaluations = 0
        while True:
            # "p = particle with the largest priority; place the tools around p: best score, no collision with the body"
            placements = self.placer.ask(stage)
            clock.lap("placement")
            if not placements:
                break
            # "for each candidate pose in T: actions, loss = minimise the shape loss through the simulator"
            found = self._optimize(index, state, placements, generator)
            evaluations += sum(plans.gradient_evaluations for plans in found)
            history.extend(iteration for plans in found for iteration in plans.history)
            results = _pair(placements, found)
            candidates.extend(results)
            clock.lap("optimization")
            if not self.placer.tell(results):
                break
        # "execute the plan with the lowest loss"
        best = min(range(len(candidates)), key=lambda i: candidates[i].loss, default=None)
        status = _stage_status(candidates, best, loss_before)
        trajectory, loss = None, loss_before
        if status is Status.FINISHED and best is not None:
            trajectory, loss = self._execute(state, candidates[best])
            # A warm-started loss may flatter its plan.
            if not loss < loss_before:
                trajectory, loss, status = None, loss_before, Status.NO_IMPROVEMENT
        clock.lap("execution")
        if trajectory is not None and best is not None and self.refinement is not None:
            refined = self._refine(self.refinement, index, state, candidates[best], loss_before)
            evaluations += refined.plans.gradient_evaluations
            history.extend(refined.plans.history)
            if refined.trajectory is not None:
                trajectory, loss = refined.trajectory, refined.loss
                candidates[best] = dataclasses.replace(candidates[best], actions=trajectory.actions[0], loss=loss)
            clock.lap("refinement")
        seconds["total"] = clock.total()
        finished = trajectory is not None
        return StageResult(
            index=index,
            status=status,
            state_before=state,
            state=trajectory.final_state if trajectory is not None else state,
            priorities=priorities,
            candidates=tuple(candidates),
            best=best if finished else None,
            actions=trajectory.actions[0] if trajectory is not None else None,
            positions=trajectory.positions[0] if trajectory is not None else None,
            manipulator_poses=trajectory.manipulator_poses[0] if trajectory is not None else None,
            loss_before=loss_before,
            loss=loss,
            gradient_evaluations=evaluations,
            history=tuple(history),
            seconds=seconds,
        )

    def _optimize(
        self, index: int, state: State, placements: list[Placement], generator: torch.Generator
    ) -> list[OptimizationResult]:
        """Solve all placements, as many worlds at a time as the simulator holds."""
        # All first actions are drawn at once, so that the result does not depend on how many worlds fit into a batch.
        shape = (len(placements), self.task.step_count, self.task.scene.action_size)
        first_actions = self.optimizer.initial_actions(shape, generator)
        first_actions = torch.nn.functional.pad(first_actions, (0, 0, 0, self.task.rest_steps))
        found = []
        for start in range(0, len(placements), self.simulator.batch_size):
            part = placements[start : start + self.simulator.batch_size]
            check_memory(self.simulator, step_count=self.task.rollout_steps, worlds=len(part))
            worlds = state.fork(len(part)).with_manipulators(torch.stack([placement.pose for placement in part]))
            actions = first_actions[start : start + len(part)]
            estimate = self.simulator.memory_estimate(self.task.rollout_steps, worlds=len(part))
            for observer in self.observers:
                observer.optimization_started(index, len(part), estimate)
            self.objective.reset()
            found.append(
                self.optimizer.minimize(
                    self.simulator,
                    worlds,
                    actions,
                    self.objective,
                    rest_steps=self.task.rest_steps,
                    on_iteration=self._notifier(index),
                )
            )
        return found

    def _refine(self, refinement: Refinement, index: int, state: State, candidate: PlacementResult, loss_before: float) -> _Refined:
        """Refine a plan, and execute what was found if the refinement's objective fell and the stage's is below its start's."""
        start = state.with_manipulators(candidate.placement.pose.unsqueeze(0))
        rest, notify = self.task.rest_steps, self._notifier(index)
        plans = refinement.refine(self.simulator, start, candidate.actions, rest_steps=rest, on_iteration=notify)
        if not gained(plans):
            return _Refined(plans, None, loss_before)
        trajectory, loss = self._execute(state, dataclasses.replace(candidate, actions=plans.actions[0]))
        return _Refined(plans, trajectory if loss < loss_before else None, loss)

    def _notifier(self, index: int) -> Callable[[Iteration], None]:
        def notify(iteration: Iteration) -> None:
            for observer in self.observers:
                observer.iteration_finished(index, iteration)

        return notify

    def _execute(self, state: State, candidate: PlacementResult) -> tuple[Trajectory, float]:
        """Run the chosen plan once more, as a single world, and take its loss by a fresh (not warm-started) evaluation."""
        start = state.with_manipulators(candidate.placement.pose.unsqueeze(0))
        trajectory = self.simulator.rollout(start, candidate.actions.unsqueeze(0))
        return trajectory, float(self.objective.begin(trajectory).loss[0])


def stage_generator(seed: int, index: int) -> torch.Generator:
    """Random numbers of the stage with the given number; they depend on nothing that happened before it."""
    if index > 0:
        seed = int(np.random.SeedSequence([seed, index]).generate_state(1)[0])
    return torch.Generator().manual_seed(seed)


def failed_contacts(stages: Sequence[StageResult]) -> tuple[int, ...]:
    """Contact particles of the candidates of all stages since the last one that gained at least `LEAST_GAIN`."""
    found: list[int] = []
    for stage in reversed(stages):
        if stage.loss < (1.0 - LEAST_GAIN) * stage.loss_before:
            break
        contacts = [candidate.placement.contact_particle for candidate in stage.candidates]
        found += [contact for contact in contacts if contact is not None]
    return tuple(dict.fromkeys(found))


def check_tools_outside(scene: Scene, state: State) -> None:
    """Raise `InputError` where a tool begins inside the body, from where the first step would throw the clay apart.

    Args:
        scene: Its tools.
        state: The scene's start, a single world.
    """
    for index, manipulator in enumerate(scene.manipulators):
        depth = -float(signed_distance(manipulator, state.manipulator_pose[0, index], state.position[0]).min())
        if depth > MAX_START_DEPTH:
            raise InputError(
                f"scene.manipulators.{index}",
                came=f"a {manipulator.kind} that starts {depth:.3g} length units deep inside the body",
                expected=f"a tool outside of it (at most {MAX_START_DEPTH:g} deep)",
                remedy=f"Change its position, for example with --set scene.manipulators.{index}.position=[x,y,z].",
            )


def still_trajectory(state: State, step_count: int, *, scene: Scene) -> Trajectory:
    """A trajectory of `step_count` steps during which nothing moves, to take the loss of a state.

    Only its last step arrives with the velocity of the state, for an objective that asks whether the clay is at rest.
    """
    worlds = state.batch_size
    positions = state.position.unsqueeze(1).repeat(1, step_count + 1, 1, 1)
    seconds = scene.time_step * scene.substeps
    positions[:, -2] = (state.position - seconds * state.velocity).clamp(0.0, 1.0)
    return Trajectory(
        positions=positions,
        manipulator_poses=state.manipulator_pose.unsqueeze(1).expand(-1, step_count + 1, -1, -1),
        actions=torch.zeros(worlds, step_count, scene.action_size, dtype=state.position.dtype, device=state.position.device),
        initial_state=state,
        final_state=state,
    )


def _pair(placements: list[Placement], found: Iterable[OptimizationResult]) -> list[PlacementResult]:
    plans = [plan for result in found for plan in zip(result.loss, result.actions, result.finite, strict=True)]
    return [
        PlacementResult(placement, float(loss), actions, bool(finite))
        for placement, (loss, actions, finite) in zip(placements, plans, strict=True)
    ]


def _stage_status(candidates: list[PlacementResult], best: int | None, loss_before: float) -> Status:
    if best is None:
        return Status.NO_PLACEMENT
    if candidates[best].loss < loss_before:
        return Status.FINISHED
    return Status.NO_IMPROVEMENT if any(candidate.finite for candidate in candidates) else Status.NON_FINITE


@dataclasses.dataclass(frozen=True)
class _Refined:
    """Plans of a refinement, and the execution of the best one; None where the plan stays as it was."""

    plans: OptimizationResult
    trajectory: Trajectory | None
    loss: float


class _Clock:
    """Adds the wall time since the last lap to named entries."""

    def __init__(self, seconds: dict[str, float]) -> None:
        self._seconds = seconds
        self._start = self._mark = time.perf_counter()

    def lap(self, name: str) -> None:
        now = time.perf_counter()
        self._seconds[name] = self._seconds.get(name, 0.0) + now - self._mark
        self._mark = now

    def total(self) -> float:
        return time.perf_counter() - self._start
