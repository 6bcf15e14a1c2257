"""A scene with fewer particles, for all that is only tried: most touches are dropped, and a coarse rollout is enough to see why."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from cpdeform.core.placer import Candidate
from cpdeform.core.scene import Scene
from cpdeform.core.simulator import Simulator, Trajectory
from cpdeform.core.state import State
from cpdeform.planning.algorithm import Planner, Start
from cpdeform.planning.chain import begin_stage
from cpdeform.planning.interrupted import StageInterrupted
from cpdeform.planning.objectives.shape import ObjectiveShape
from cpdeform.planning.result import StageResult, Status
from cpdeform.planning.still import still_trajectory
from cpdeform.planning.workbench import is_finite

PARTICLES_PER_CELL = 1.7
"""Particles per cell of the grid that a coarse scene keeps. Of 64 touches on `star`, whose 10,000 particles fill a cell by 6.7, a
quarter of them ranks the losses as all do (Spearman 0.92) in a third of the time, and takes a fifth for a gradient."""

MOST_EXECUTED = 3
"""Plans of a coarse stage that are tried with all particles."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class CoarseModel:
    """Every k-th particle of a scene. A particle's mass and volume stay as they are, and so does the motion of the clay.

    Attributes:
        simulator: Simulates the coarse scene.
        kept: Indices (n,) of the particles that are kept.
    """

    simulator: Simulator
    kept: Tensor

    @classmethod
    def of(cls, simulator: Simulator) -> CoarseModel | None:
        """The coarse model of a simulator's scene; None where its particles are few already."""
        scene = simulator.scene
        factor = coarsening(scene)
        if factor < 2:
            return None
        bodies, kept, first = [], list[Tensor](), 0
        for body in scene.bodies:
            kept.append(torch.arange(first, first + body.particle_count, factor))
            bodies.append(body.model_copy(update={"particle_count": len(kept[-1])}))
            first += body.particle_count
        coarse = scene.model_copy(update={"bodies": tuple(bodies)})
        return cls(simulator=simulator.for_scene(coarse), kept=torch.cat(kept).to(simulator.device))

    def thinned(self, state: State) -> State:
        """A state with the kept particles alone."""
        fields = ("position", "velocity", "affine", "elastic_strain")
        return dataclasses.replace(state, **{name: getattr(state, name)[:, self.kept].contiguous() for name in fields})


def coarsening(scene: Scene) -> int:
    """How many particles of a scene one stands for in its coarse model; 1 for none to be dropped."""
    cells = sum(body.volume for body in scene.bodies) * scene.grid_size**3
    return max(1, round(scene.particle_count / max(cells, 1.0) / PARTICLES_PER_CELL))


@dataclasses.dataclass(frozen=True, kw_only=True)
class CoarsePlanner:
    """Plans stages with the coarse model, and executes them with all particles.

    Attributes:
        full: The parts of the run.
        coarse: The same parts for the coarse model.
        start: Goal and stages of the run, for the coarse model.
        model: The coarse model.
    """

    full: Planner
    coarse: Planner
    start: Start
    model: CoarseModel

    @classmethod
    def of(cls, planner: Planner, start: Start) -> CoarsePlanner | None:
        """The coarse parts of a run; None where there is no coarse model, or the loss is not made for one.

        Args:
            planner: The parts.
            start: Goal, and the state that the loss is measured from.
        """
        model, objective = CoarseModel.of(planner.simulator), planner.objective
        if model is None or not isinstance(objective, ObjectiveShape):
            return None
        begin = model.thinned(start.state)
        # A goal of corresponding particles stays one: the same are kept of both.
        goal = start.goal[model.kept] if len(start.goal) == planner.task.scene.particle_count else start.goal
        coarse = dataclasses.replace(
            planner,
            task=planner.task.model_copy(update={"scene": model.simulator.scene}),
            simulator=model.simulator,
            objective=objective.rebased(goal=goal, start=objective.start[model.kept]),
        )
        return cls(full=planner, coarse=coarse, start=dataclasses.replace(start, state=begin, goal=goal), model=model)

    def stage(self, index: int, state: State, *, warm: tuple[object, ...] | None = None) -> StageResult:
        """Plan a stage coarsely; of its best plans, execute the one that is best with all particles.

        Args:
            index: Number of the stage.
            state: State S_i with all particles, a single world.
            warm: What the objective can start from there.

        Raises:
            StageInterrupted: A `KeyboardInterrupt` came when a plan had been found; it holds the stage with the best one so far.
        """
        try:
            return self._executed(self.coarse.stage(self.start, index, self.model.thinned(state), []), state, warm)
        except StageInterrupted as interruption:
            result = self._executed(interruption.result, state, warm)
            if result.best is None:
                raise KeyboardInterrupt from interruption
            raise StageInterrupted(dataclasses.replace(result, status=Status.INTERRUPTED)) from interruption

    def _executed(self, found: StageResult, state: State, warm: tuple[object, ...] | None) -> StageResult:
        """A coarse stage with the best of its plans executed with all particles."""
        begun = time.perf_counter()
        still = still_trajectory(state, self.full.task.rollout_steps, scene=self.full.task.scene)
        before = self.full.objective.evaluate(still, warm)
        order = sorted(range(len(found.candidates)), key=lambda number: found.candidates[number].loss)[:MOST_EXECUTED]
        tried = {
            number: self._execute(found.candidates[number], state) for number in order if found.candidates[number].actions.numel()
        }
        losses = {number: loss for number, (_, loss, _) in tried.items()}
        best = min(losses, key=lambda number: losses[number], default=None)
        gained = best is not None and losses[best] < float(before.loss[0])
        result = dataclasses.replace(
            found,
            status=_status(found, losses, gained=gained),
            state_before=state,
            state=state,
            priorities=self._priorities(found.priorities, state),
            candidates=self._candidates(found.candidates, losses),
            best=None,
            actions=None,
            positions=None,
            tool_poses=None,
            loss_before=float(before.loss[0]),
            loss=float(before.loss[0]),
            rollouts=found.rollouts + len(tried),
            warm=before.warm,
        )
        result.seconds["execution"] = result.seconds.get("execution", 0.0) + time.perf_counter() - begun
        if best is None or not gained:
            return result
        trajectory, loss, after = tried[best]
        return dataclasses.replace(
            result,
            state=trajectory.final_state,
            best=best,
            actions=trajectory.actions[0],
            positions=trajectory.positions[0],
            tool_poses=trajectory.tool_poses[0],
            loss=loss,
            warm=after,
        )

    def _execute(self, candidate: Candidate, state: State) -> tuple[Trajectory, float, tuple[object, ...] | None]:
        """A plan with all particles: trajectory, loss (infinite where it is not finite), and what the loss can start from then."""
        actions = candidate.actions.unsqueeze(0).to(state.position)
        trajectory = self.full.simulator.rollout(
            begin_stage(self.full.task.scene, state, candidate.proposal.pose, actions), actions
        )
        if not is_finite(trajectory):
            return trajectory, float("inf"), None
        evaluated = self.full.objective.evaluate(trajectory)
        return trajectory, float(evaluated.loss[0]), evaluated.warm

    def _candidates(self, candidates: Sequence[Candidate], losses: dict[int, float]) -> tuple[Candidate, ...]:
        """The candidates with contact particles of the whole scene, those that were executed with their loss there."""
        result = []
        for number, candidate in enumerate(candidates):
            contact = candidate.proposal.contact_particle
            whole = None if contact is None else int(self.model.kept[contact])
            proposal = dataclasses.replace(candidate.proposal, contact_particle=whole)
            result.append(dataclasses.replace(candidate, proposal=proposal, loss=losses.get(number, candidate.loss)))
        return tuple(result)

    def _priorities(self, priorities: Tensor, state: State) -> Tensor:
        """Priorities (N,) of all particles: those of the nearest one that was kept."""
        from scipy.spatial import cKDTree

        position = state.position[0].detach().cpu().numpy()
        _, nearest = cKDTree(position[self.model.kept.cpu().numpy()]).query(position)
        return priorities[torch.as_tensor(np.asarray(nearest)).to(priorities.device)]


def _status(found: StageResult, losses: dict[int, float], *, gained: bool) -> Status:
    if gained:
        return Status.FINISHED
    if not losses or found.status is Status.NO_PLACEMENT:
        return found.status if found.status is not Status.FINISHED else Status.NO_IMPROVEMENT
    return Status.NO_IMPROVEMENT if any(np.isfinite(loss) for loss in losses.values()) else Status.NON_FINITE
