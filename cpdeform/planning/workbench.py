"""What the phases of a stage work with: the stage, the simulator, and counters of what was spent."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from cpdeform.core.final_gradient import state_tensors
from cpdeform.core.memory_limit import check_memory
from cpdeform.core.objective import Objective
from cpdeform.core.placer import Candidate, Stage
from cpdeform.core.simulator import Simulator, Trajectory
from cpdeform.core.state import State
from cpdeform.core.task import Task
from cpdeform.planning.batches import Evaluator, evaluate_worlds
from cpdeform.planning.executor import Executor, ExecutorSerial
from cpdeform.planning.optimizer import Iteration, OptimizationResult, TrajectoryOptimizer
from cpdeform.planning.placed import Placing, SimulatorPlaced
from cpdeform.planning.race import Race
from cpdeform.planning.stage_start import begin_stage


@dataclasses.dataclass(kw_only=True)
class Racing:
    """A descent, while it runs and until its candidates are kept.

    Attributes:
        phase: Name of the phase that asked for it.
        objective: Its loss.
        candidates: Its candidates, one a world.
        race: The worlds; None before they start.
        first_loss: Loss of the first candidate's first actions; None before it is known.
        placing: What the rows before the actions mean; None where there are none.
    """

    phase: str
    objective: Objective
    candidates: tuple[Candidate, ...]
    race: Race | None = None
    first_loss: float | None = None
    placing: Placing | None = None

    def plan(self, number: int, actions: Tensor) -> Candidate:
        """A candidate with the plan that actions (rows + T, A) of its world are, tools placed by their rows."""
        candidate = self.candidates[number]
        if self.placing is None or self.race is None:
            return dataclasses.replace(candidate, actions=actions)
        state = self.race.state.map(lambda tensor: tensor[number : number + 1])
        rows, rest = self.placing.split(actions.unsqueeze(0))
        start = begin_stage(self.placing.scene, state, self.placing.placed(state.tool_pose, rows), rest)
        proposal = dataclasses.replace(candidate.proposal, pose=start.tool_pose[0].to(candidate.proposal.pose))
        return dataclasses.replace(candidate, proposal=proposal, actions=rest[0])


@dataclasses.dataclass(kw_only=True)
class Workbench:
    """A stage in the making. Phases compute through it, so that nothing is spent without being counted.

    Attributes:
        stage: State, goal, transport and random numbers.
        task: Numbers of steps and of steps of rest.
        simulator: Physics.
        objective: The stage's loss, by which plans are chosen and executed.
        warm: What the objective can start from, found where the stage begins; every world of the stage begins near there.
        executor: Where batches are computed.
        on_iteration: Told of each iteration of a descent.
        on_batch: Told of the worlds of a batch and the memory that they need, bytes, before it is computed.
        gradient_evaluations: Gradients computed so far, of all worlds together.
        rollouts: Rollouts without a gradient so far.
        history: Every iteration so far, in order.
        candidates: The candidates of all rounds that are over.
        rest_loss: Loss after leaving the clay alone for as long as a plan takes; None where it does not count.
        racing: The descent that runs, or ran last; None once its candidates are kept.
        seconds: Wall time by part.
    """

    stage: Stage
    task: Task
    simulator: Simulator
    objective: Objective
    warm: tuple[object, ...] | None = None
    executor: Executor = dataclasses.field(default_factory=ExecutorSerial)
    on_iteration: Callable[[Iteration], None] = lambda iteration: None
    on_batch: Callable[[int, int], None] = lambda worlds, memory: None
    gradient_evaluations: int = 0
    rollouts: int = 0
    history: list[Iteration] = dataclasses.field(default_factory=list)
    candidates: list[Candidate] = dataclasses.field(default_factory=list)
    rest_loss: float | None = None
    racing: Racing | None = None
    seconds: dict[str, float] = dataclasses.field(default_factory=dict)

    def __post_init__(self) -> None:
        self._start = self._mark = time.perf_counter()

    def lap(self, name: str) -> None:
        """Add the wall time since the last lap to a part."""
        now = time.perf_counter()
        self.seconds[name] = self.seconds.get(name, 0.0) + now - self._mark
        self._mark = now

    @property
    def loss_to_beat(self) -> float:
        """The loss that a plan has to be below: that of the stage's state, or of what it becomes if it is left alone."""
        return self.stage.loss if self.rest_loss is None else self.rest_loss

    def measure_rest(self) -> None:
        """Leave the clay alone for as long as a plan takes, and let plans be compared with what comes of that."""
        state, shape = self.stage.state, (1, self.task.rollout_steps, self.task.scene.action_size)
        trajectory = self.simulator.simulate(state, state.position.new_zeros(shape))
        self.rollouts += 1
        if is_finite(trajectory):
            self.rest_loss = float(self.objective.losses(trajectory, self.warm)[0])

    def keep(self, candidates: Sequence[Candidate]) -> None:
        """Keep the candidates of a round that is over."""
        self.candidates += candidates
        self.racing = None

    def total(self) -> float:
        """Wall time since the stage began, seconds."""
        return time.perf_counter() - self._start

    def first_actions(self, candidates: Sequence[Candidate], optimizer: TrajectoryOptimizer) -> list[Candidate]:
        """Give candidates without actions their first ones: the proposal's, or the optimiser's small noise.

        All are drawn at once, so that the result does not depend on how many worlds fit into a batch.

        Args:
            candidates: Candidates; those that have actions stay as they are.
            optimizer: Draws them.
        """
        fresh = [number for number, candidate in enumerate(candidates) if not candidate.actions.numel()]
        shape = (len(fresh), self.task.step_count, self.task.scene.action_size)
        if any(candidates[number].proposal.actions is None for number in fresh):
            drawn = optimizer.initial_actions(shape, self.stage.generator)
        else:
            drawn = torch.zeros(shape)
        result = list(candidates)
        for number, noise in zip(fresh, drawn, strict=True):
            own = candidates[number].proposal.actions
            padded = torch.nn.functional.pad(noise if own is None else own, (0, 0, 0, self.task.rest_steps))
            result[number] = dataclasses.replace(candidates[number], actions=padded)
        return result

    def worlds(self, candidates: Sequence[Candidate]) -> State:
        """The stage's state in a world for each candidate, tools placed."""
        poses = torch.stack([candidate.proposal.pose for candidate in candidates])
        return self.stage.state.fork(len(candidates)).with_tools(poses)

    def minimize(
        self,
        candidates: Sequence[Candidate],
        optimizer: TrajectoryOptimizer,
        objective: Objective | None,
        *,
        phase: str,
        placing: Placing | None = None,
    ) -> OptimizationResult:
        """Minimise an objective over the actions of candidates, count what it took, and tell of each iteration.

        Args:
            candidates: Candidates with actions.
            optimizer: How.
            objective: The loss; None for the stage's own.
            phase: Name of the phase that asks.
            placing: How far the tools may be placed anew; None leaves them where they are. With it the actions that come back begin
                with its rows; `Racing.plan` makes plans of them.
        """
        self._announce(len(candidates))
        loss = self.objective if objective is None else objective
        racing = self.racing = Racing(phase=phase, objective=loss, candidates=tuple(candidates), placing=placing)
        actions = torch.stack([candidate.actions for candidate in candidates])
        first = len(self.history)

        def begin(race: Race) -> None:
            racing.race = race

        def note(iteration: Iteration) -> None:
            self.history.append(dataclasses.replace(iteration, phase=phase))
            if racing.first_loss is None:
                racing.first_loss = float(iteration.loss[0])
            self.on_iteration(self.history[-1])

        try:
            found = optimizer.minimize(
                self.simulator if placing is None else SimulatorPlaced(self.simulator, placing),
                self.worlds(candidates),
                actions if placing is None else placing.before(actions),
                loss,
                rest_steps=self.task.rest_steps,
                warm=self._warm(objective, len(candidates)),
                executor=self.executor,
                on_iteration=note,
                on_start=begin,
            )
        except KeyboardInterrupt:
            self.gradient_evaluations += racing.race.evaluations if racing.race is not None else 0
            raise
        self.gradient_evaluations += found.gradient_evaluations
        return dataclasses.replace(found, history=tuple(self.history[first:]))

    def rollout_losses(self, candidates: Sequence[Candidate], objective: Objective | None, *, phase: str) -> Tensor:
        """Losses (B,) of the candidates' actions by rollouts without gradients; nan where one is not finite.

        Args:
            candidates: Candidates with actions.
            objective: The loss; None for the stage's own.
            phase: Name of the phase that asks.
        """
        self._announce(len(candidates))
        losses = []
        evaluator = Evaluator(self.simulator, self.objective if objective is None else objective, with_gradient=False)
        # Piece by piece: the states of hundreds of worlds need not be there at once.
        size = self.simulator.batch_size * self.executor.width
        for start in range(0, len(candidates), size):
            part = candidates[start : start + size]
            state = self.worlds(part)
            found = evaluate_worlds(
                evaluator,
                self.executor,
                state,
                torch.stack([candidate.actions for candidate in part]).to(state.position),
                warm=self._warm(objective, len(part)) or [None] * len(part),
                stand_ins=state.position,
            )
            losses.append(found.loss)
        self.rollouts += len(candidates)
        return torch.cat(losses)

    def execute(self, candidate: Candidate) -> tuple[Trajectory, float, tuple[object, ...] | None]:
        """Run a plan once more, as a single world, and take its loss by a fresh (not warm-started) evaluation.

        Returns:
            The trajectory, its loss, and what the objective can start from at its end. The loss is nan where the rollout leaves
            the finite numbers, if only in a velocity or strain at its end: no stage can begin there.
        """
        start = self.stage.state.with_tools(candidate.proposal.pose.unsqueeze(0))
        trajectory = self.simulator.rollout(start, candidate.actions.unsqueeze(0).to(start.position))
        self.rollouts += 1
        if not is_finite(trajectory):
            return trajectory, float("nan"), None
        result = self.objective.evaluate(trajectory)
        return trajectory, float(result.loss[0]), result.warm

    def _warm(self, objective: Objective | None, worlds: int) -> list[object] | None:
        """The warm start of the stage's own objective, for every world."""
        own = objective is None or objective is self.objective
        return [self.warm[0]] * worlds if own and self.warm else None

    def _announce(self, worlds: int) -> None:
        room = min(worlds, self.simulator.batch_size)
        check_memory(self.simulator, step_count=self.task.rollout_steps, worlds=room)
        self.on_batch(room, self.simulator.memory_estimate(self.task.rollout_steps, worlds=room))


def is_finite(trajectory: Trajectory) -> bool:
    """Whether a trajectory and all of its final state are finite."""
    tensors = (trajectory.positions, trajectory.tool_poses, *state_tensors(trajectory.final_state))
    return all(bool(torch.isfinite(tensor).all()) for tensor in tensors)
