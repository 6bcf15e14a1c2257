"""Algorithm 1 of the paper: contact points discovery, then gradient descent, stage by stage [1]_.

The lines quoted in the comments are those of the algorithm.

References:
    .. [1] Li, Huang, Du, Su, Tenenbaum, Gan, "Contact Points Discovery for Soft-Body Manipulations with Differentiable
       Physics", ICLR 2022, Algorithm 1.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterator, Sequence

import numpy as np
import torch
from torch import Tensor

from cpdeform.core.errors import InputError
from cpdeform.core.memory_limit import check_memory
from cpdeform.core.objective import Objective
from cpdeform.core.ot import OTSolver, TransportProblem
from cpdeform.core.placer import Candidate, Placer, Stage
from cpdeform.core.simulator import Simulator
from cpdeform.core.state import State
from cpdeform.core.task import Task
from cpdeform.planning.checks import check_parts, check_run, check_start, check_tools_outside
from cpdeform.planning.executor import Executor, ExecutorSerial
from cpdeform.planning.interrupted import Execution, StageInterrupted, best_so_far
from cpdeform.planning.metrics import evaluate_metric
from cpdeform.planning.optimizer import Iteration
from cpdeform.planning.phases.phase import Phase
from cpdeform.planning.result import DeformResult, Observer, Revision, StageResult, Status
from cpdeform.planning.stage_parts import failed_contacts, search_status, stage_generator, stage_result
from cpdeform.planning.still import still_trajectory
from cpdeform.planning.workbench import Workbench, is_finite


@dataclasses.dataclass(frozen=True, kw_only=True)
class Start:
    """Where the stages of a run begin.

    Attributes:
        state: The state, a single world.
        goal: Goal particles G (M, 3), length units.
        first_stage: Number of the first stage.
        stages: Number of stages.
        previous: The stages before the first one, of a run that goes on.
        continued: Whether the run goes on as it began, with the same parts and settings: what comes of it is then to equal what a
            run that went through comes to, and a loop may revise the stages before.
    """

    state: State
    goal: Tensor
    first_stage: int
    stages: int
    previous: tuple[StageResult, ...] = ()
    continued: bool = False


@dataclasses.dataclass(frozen=True, kw_only=True)
class Planner:
    """The parts of Algorithm 1, put together; any part may be replaced.

    Attributes:
        task: Scene, goal and schedule.
        simulator: Differentiable physics.
        ot_solver: Solves the placer's transport problem.
        placer: Turns transport priorities into proposals.
        problem: The transport problem that `ot_solver` solves for the placer; defaults to the one that the placer declares.
        objective: The shape loss, by which plans are chosen.
        phases: The steps from proposals to a stage's plan; see `cpdeform.planning.phases.phase.Phase`.
        loop: Leads from stage to stage; defaults to Algorithm 1's, `contact_points_discovery`.
        compared_with_rest: Whether a plan has to be better than leaving the clay alone for as long, instead of better than the clay
            as it is: where it still springs back from the stage before, part of what a plan loses or gains is not the plan's.
        executor: Where batches of worlds are computed.
        seed: Seed of first actions and random placements.
        observers: Told of every iteration and stage.
        names: Names of the parts for the record.

    Example:
        Put together by hand; `cpdeform.deform` does this from names and settings.

        >>> from cpdeform import TrajectoryOptimizer, load_registry, load_task
        >>> from cpdeform.ot.pot import OTSolverPOT
        >>> from cpdeform.placement.fixed import PlacerFixed
        >>> from cpdeform.planning.objectives.transport import ObjectiveTransport
        >>> from cpdeform.planning.phases.descent import PhaseDescent
        >>> task, registry = load_task("writer"), load_registry()
        >>> board = task.scene.bodies[0].model_copy(update={"particle_count": 200})
        >>> task = task.model_copy(update={"scene": task.scene.model_copy(update={"bodies": (board,)})})
        >>> fastest = registry.resolve("simulator", "auto", device="cpu")
        >>> simulator, solver = registry.create("simulator", fastest, scene=task.scene), OTSolverPOT(blur=0.01)
        >>> planner = Planner(
        ...     task=task,
        ...     simulator=simulator,
        ...     ot_solver=solver,
        ...     placer=PlacerFixed(),
        ...     objective=ObjectiveTransport(solver, torch.as_tensor(task.load_goal()).float(), scene=task.scene, points=100),
        ...     phases=[PhaseDescent(optimizer=TrajectoryOptimizer(iterations=2))],
        ... )
        >>> result = planner.run(stages=1)
        >>> result.loss_final <= result.loss_initial
        True
    """

    task: Task
    simulator: Simulator
    ot_solver: OTSolver
    placer: Placer
    objective: Objective
    phases: Sequence[Phase]
    problem: TransportProblem | None = None
    loop: Callable[[Planner, Start], Iterator[StageResult | Revision]] | None = None
    compared_with_rest: bool = False
    executor: Executor = dataclasses.field(default_factory=ExecutorSerial)
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
        continued: bool = False,
    ) -> DeformResult:
        """Run Algorithm 1.

        Args:
            stages: Number of stages; defaults to the task's own.
            state: Where to start, a single world, e.g. the last state of a run record; defaults to the scene's start.
            first_stage: Number of the first stage: of one that goes on from a record, `RunRecord.next_stage`. With the seed it
                determines the random numbers, so that a run that is resumed equals one that went through.
            previous: The stages before the first one, of a run that goes on: contact points that failed there are not tried again.
            continued: Whether these were made with the same parts and settings; see `Start`.

        Returns:
            Every stage, those before where they were revised, and how the run ended. A stage that fails ends the run; what came
            before is kept.

        Raises:
            CapabilityError: The parts do not fit together.
            InputError: `stages` or `first_stage` is out of range, the goal or `state` cannot be used, a tool starts inside the
                body, or there is not enough memory.
        """
        count = self.task.stage_count if stages is None else stages
        check_run(count, first_stage, self.seed)
        check_parts(self.task, self.simulator, self.placer, self.ot_solver, problem=self.problem or self.placer.transport_problem)
        if not self._phases("round"):
            raise InputError(
                "phases", came="none that works on a round of candidates", expected="at least one, such as PhaseDescent"
            )
        check_memory(self.simulator, step_count=self.task.rollout_steps, worlds=1)
        scene_start = self.simulator.initial_state(batch_size=1)
        check_tools_outside(self.task.scene, scene_start)
        state = scene_start if state is None else check_start(self.task, self.simulator, state)
        begun = time.perf_counter()
        goal = torch.as_tensor(self.task.load_goal()).to(device=self.simulator.device, dtype=self.simulator.dtype)
        for observer in self.observers:
            observer.run_started(self.task, goal, self.names, self.seed)
        start = Start(state=state, goal=goal, first_stage=first_stage, stages=count, previous=tuple(previous), continued=continued)
        results = self._follow(start)
        metric = evaluate_metric(self.task, start=scene_start.position[0], final=results[-1].state.position[0], goal=goal)
        finished = DeformResult(
            task=self.task,
            goal=goal,
            stages=tuple(results),
            status=results[-1].status,
            loss_initial=results[0].loss_before,
            loss_final=results[-1].loss,
            metric_name=self.task.metric,
            metric_initial=metric.initial,
            metric_value=metric.final,
            gradient_evaluations=sum(result.gradient_evaluations for result in results),
            rollouts=sum(result.rollouts for result in results),
            seconds=time.perf_counter() - begun,
            names=self.names,
            seed=self.seed,
        )
        for observer in self.observers:
            observer.run_finished(finished)
        return finished

    def _follow(self, start: Start) -> list[StageResult]:
        """Every stage that the loop leads to, with its latest plan; observers are told as it goes on."""
        results: list[StageResult] = []
        for found in (self.loop or contact_points_discovery)(self, start):
            if isinstance(found, Revision):
                results[-len(found.results) :] = found.results
                for observer in self.observers:
                    observer.stages_revised(found)
            else:
                results.append(found)
                for observer in self.observers:
                    observer.stage_finished(found)
        return results

    def stage(
        self,
        start: Start,
        index: int,
        state: State,
        before: Sequence[StageResult],
        *,
        warm: tuple[object, ...] | None = None,
    ) -> StageResult:
        """Plan and execute one stage.

        Args:
            start: Goal and stages of the run.
            index: Number of the stage.
            state: State S_i, a single world.
            before: All stages that led here, the oldest first.
            warm: What the objective can start from, of the stage before (`StageResult.warm`).

        Raises:
            StageInterrupted: A `KeyboardInterrupt` came when a plan had been found; it holds the stage with the best one so far.
        """
        bench = self._workbench(start, index, state, before, warm)
        execution = Execution(bench.stage.loss, bench.warm)
        try:
            candidates = self._search(bench)
            for phase in self._phases("search"):
                self.tell_part(index, phase.name)
                candidates = phase.run(bench, candidates)
                bench.lap(phase.name)
            return self._plan(bench, candidates, execution)
        except KeyboardInterrupt as interruption:
            best = best_so_far(bench, self.phases, execution, self._execute)
            if best is None:
                raise
            raise StageInterrupted(stage_result(bench, *best, Status.INTERRUPTED, execution)) from interruption

    def _plan(self, bench: Workbench, candidates: list[Candidate], execution: Execution) -> StageResult:
        """Execute the best candidate of a stage, and let further phases work on it."""
        # "execute the plan with the lowest loss"
        best = min(range(len(candidates)), key=lambda number: candidates[number].loss, default=None)
        status = search_status(candidates, best, bench.loss_to_beat)
        if best is not None and status is Status.FINISHED:
            self.tell_part(bench.stage.index, "execution")
            status = self._execute(bench, self._phases("round", "search")[-1], candidates[best], execution)
        bench.lap("execution")
        if best is not None and status is Status.FINISHED:
            for phase in self._phases("plan"):
                self.tell_part(bench.stage.index, phase.name)
                for changed in phase.run(bench, [candidates[best]]):
                    self._execute(bench, phase, changed, execution)
                bench.lap(phase.name)
            candidates[best] = execution.candidate or candidates[best]
        return stage_result(bench, candidates, best, status, execution)

    def execute_other(self, result: StageResult, number: int) -> StageResult | None:
        """What a stage would have come to by another of its candidates, for loops that follow several ways at once.

        Args:
            result: A stage.
            number: Which of its candidates.

        Returns:
            The stage with that candidate executed; None where it gains nothing.
        """
        candidate = result.candidates[number]
        before = result.state_before
        trajectory = self.simulator.rollout(
            before.with_tools(candidate.proposal.pose.unsqueeze(0)), candidate.actions.unsqueeze(0).to(before.position)
        )
        if not is_finite(trajectory):
            return None
        found = self.objective.evaluate(trajectory)
        if not float(found.loss[0]) < result.loss_before:
            return None
        return dataclasses.replace(
            result,
            state=trajectory.final_state,
            best=number,
            actions=trajectory.actions[0],
            positions=trajectory.positions[0],
            tool_poses=trajectory.tool_poses[0],
            loss=float(found.loss[0]),
            warm=found.warm,
        )

    def warm_at(self, start: Start) -> tuple[object, ...] | None:
        """What the objective can start from where a run goes on: the same as its last stage told when it was found.

        Args:
            start: Where the run goes on.

        Returns:
            An entry for the single world; None for a run from its start, or one whose parts or settings are others now.
        """
        if not (start.continued and start.previous):
            return None
        return self.objective.evaluate(still_trajectory(start.state, self.task.rollout_steps, scene=self.task.scene)).warm

    def _workbench(
        self, start: Start, index: int, state: State, before: Sequence[StageResult], warm: tuple[object, ...] | None
    ) -> Workbench:
        """What the phases of a stage work with, transport solved."""
        generator, failed = stage_generator(self.seed, index), failed_contacts([*start.previous, *before])
        stage = Stage(
            index,
            self.task.scene,
            state,
            start.goal,
            None,
            generator,
            failed_contacts=failed,
            step_count=self.task.step_count,
        )
        bench = Workbench(
            stage=stage,
            task=self.task,
            simulator=self.simulator,
            objective=self.objective,
            executor=self.executor,
            on_iteration=lambda iteration: self.tell_iteration(index, iteration),
            on_batch=lambda worlds, memory: self.tell_batch(index, worlds, memory),
        )
        self.tell_part(index, "transport")
        begin = self.objective.evaluate(still_trajectory(state, self.task.rollout_steps, scene=self.task.scene), warm)
        # "priorities f = optimal-transport potentials between current shape S_i and goal G"
        wanted = self.placer.transport_problem is not None
        transport = self.ot_solver.solve(state.position[0], start.goal) if wanted else None
        bench.stage, bench.warm = dataclasses.replace(stage, transport=transport, loss=float(begin.loss[0])), begin.warm
        if self.compared_with_rest:
            bench.measure_rest()
        bench.lap("transport")
        return bench

    def _search(self, bench: Workbench) -> list[Candidate]:
        """All candidates of a stage, round by round."""
        while True:
            # "p = particle with the largest priority; place the tools around p: best score, no collision with the body"
            self.tell_part(bench.stage.index, "placement")
            proposals = self.placer.ask(bench.stage)
            bench.lap("placement")
            if not proposals:
                return bench.candidates
            # "for each candidate pose in T: actions, loss = minimise the shape loss through the simulator"
            found = [Candidate(proposal, float("nan"), proposal.pose.new_empty(0)) for proposal in proposals]
            for phase in self._phases("round"):
                self.tell_part(bench.stage.index, phase.name)
                found = phase.run(bench, found)
            bench.keep(found)
            bench.lap("optimization")
            if not self.placer.tell(found):
                return bench.candidates

    def _execute(self, bench: Workbench, phase: Phase, candidate: Candidate, execution: Execution) -> Status:
        """Execute a plan and keep what came of it, if its phase accepts that."""
        trajectory, loss, warm = bench.execute(candidate)
        if not np.isfinite(loss):
            return Status.NON_FINITE
        # A warm-started loss may flatter its plan, and sums in another order may make a rollout at the brink break.
        if not phase.accepts(loss, loss_before=bench.loss_to_beat, loss_now=execution.loss):
            return Status.NO_IMPROVEMENT
        execution.trajectory, execution.loss, execution.warm = trajectory, loss, warm
        if phase.scope == "plan":
            execution.candidate = dataclasses.replace(candidate, actions=trajectory.actions[0], loss=loss)
        return Status.FINISHED

    def _phases(self, *scopes: str) -> list[Phase]:
        return [phase for phase in self.phases if phase.scope in scopes]

    def tell_part(self, index: int, part: str) -> None:
        """Tell the observers of a part of a stage; see `Observer.part_started`."""
        for observer in self.observers:
            observer.part_started(index, part)

    def tell_iteration(self, index: int, iteration: Iteration) -> None:
        """Tell the observers of an iteration; see `Observer.iteration_finished`."""
        for observer in self.observers:
            observer.iteration_finished(index, iteration)

    def tell_batch(self, index: int, worlds: int, memory: int) -> None:
        """Tell the observers of a batch of worlds; see `Observer.optimization_started`."""
        for observer in self.observers:
            observer.optimization_started(index, worlds, memory)


def contact_points_discovery(planner: Planner, start: Start) -> Iterator[StageResult]:
    """The loop of Algorithm 1: execute each stage's best plan and go on from there; a stage that fails is the last one.

    Args:
        planner: The parts.
        start: Where to begin.

    Returns:
        The result of each stage, as soon as it is known; that of an interrupted one before the interruption goes on.
    """
    results: list[StageResult] = []
    state, warm = start.state, planner.warm_at(start)
    # "for each stage:"
    for index in range(start.first_stage, start.first_stage + start.stages):
        try:
            result = planner.stage(start, index, state, results, warm=warm)
        except StageInterrupted as interruption:
            yield interruption.result
            raise
        results.append(result)
        yield result
        if result.status is not Status.FINISHED:
            return
        state, warm = result.state, result.warm
