"""A scene with fewer particles, for all that is only tried: most touches are dropped, and a coarse rollout is enough to see why."""

from __future__ import annotations

import dataclasses
import time

import numpy as np
import torch
from torch import Tensor

from cpdeform.core.placer import Candidate
from cpdeform.core.scene import Scene
from cpdeform.core.simulator import Simulator
from cpdeform.core.state import State
from cpdeform.planning.algorithm import Planner, Start
from cpdeform.planning.chain import begin_stage
from cpdeform.planning.interrupted import StageInterrupted
from cpdeform.planning.objectives.shape import ObjectiveShape
from cpdeform.planning.optimizer import TrajectoryOptimizer
from cpdeform.planning.result import StageResult, Status
from cpdeform.planning.still import still_trajectory
from cpdeform.planning.workbench import is_finite

PARTICLES_PER_CELL = 1.7
"""Particles per cell of the grid that a coarse scene keeps. Of 64 touches on `star`, whose 10,000 particles fill a cell by 6.7, a
quarter of them ranks the losses as all do (Spearman 0.92) in a third of the time, and takes a fifth for a gradient."""

MOST_POLISHED = 3
"""Plans of a coarse stage that are polished with all particles."""


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
        polish: How the best plans of a coarse stage are polished with all particles.
    """

    full: Planner
    coarse: Planner
    start: Start
    model: CoarseModel
    polish: TrajectoryOptimizer

    @classmethod
    def of(cls, planner: Planner, start: Start, *, polish: TrajectoryOptimizer) -> CoarsePlanner | None:
        """The coarse parts of a run; None where there is no coarse model, or the loss is not made for one.

        Args:
            planner: The parts.
            start: Goal and state.
            polish: How the best plans of a coarse stage are polished with all particles.
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
        begun = dataclasses.replace(start, state=begin, goal=goal)
        return cls(full=planner, coarse=coarse, start=begun, model=model, polish=polish)

    def stage(self, index: int, state: State, *, warm: tuple[object, ...] | None = None) -> StageResult:
        """Plan a stage coarsely, polish its best plans with all particles, and execute the best of them.

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
        """A coarse stage whose best plans are polished with all particles, and the best of them executed."""
        begun = time.perf_counter()
        still = still_trajectory(state, self.full.task.rollout_steps, scene=self.full.task.scene)
        before = self.full.objective.evaluate(still, warm)
        candidates, count = self._polished(found, state, before.warm)
        result = dataclasses.replace(
            found,
            status=Status.NO_IMPROVEMENT if found.status is Status.FINISHED else found.status,
            state_before=state,
            state=state,
            priorities=self._priorities(found.priorities, state),
            candidates=candidates,
            best=None,
            actions=None,
            positions=None,
            tool_poses=None,
            loss_before=float(before.loss[0]),
            loss=float(before.loss[0]),
            gradient_evaluations=found.gradient_evaluations + count,
            warm=before.warm,
        )
        best = min(range(len(candidates)), key=lambda number: candidates[number].loss, default=None)
        if best is not None and candidates[best].loss < result.loss:
            result = self._execute(result, best)
        result.seconds["execution"] = result.seconds.get("execution", 0.0) + time.perf_counter() - begun
        return result

    def _polished(self, found: StageResult, state: State, warm: tuple[object, ...] | None) -> tuple[tuple[Candidate, ...], int]:
        """All candidates, the best few with plans and losses of all particles and the others out of the race; gradients spent."""
        whole = [self._whole(candidate) for candidate in found.candidates]
        order = sorted(range(len(whole)), key=lambda number: whole[number].loss)
        chosen = [number for number in order if whole[number].actions.numel() and np.isfinite(whole[number].loss)][:MOST_POLISHED]
        candidates = [dataclasses.replace(candidate, loss=float("inf")) for candidate in whole]
        if not chosen:
            return tuple(candidates), 0
        actions = torch.stack([whole[number].actions for number in chosen]).to(state.position)
        poses = torch.stack([whole[number].proposal.pose for number in chosen])
        start = begin_stage(self.full.task.scene, state.fork(len(chosen)), poses, actions)
        descent = self.polish.minimize(
            self.full.simulator,
            start,
            actions,
            self.full.objective,
            rest_steps=self.full.task.rest_steps,
            warm=None if warm is None else list(warm) * len(chosen),
            executor=self.full.executor,
        )
        for place, number in enumerate(chosen):
            proposal = dataclasses.replace(whole[number].proposal, pose=start.tool_pose[place])
            loss, plan = float(descent.loss[place]), descent.actions[place]
            candidates[number] = dataclasses.replace(whole[number], proposal=proposal, loss=loss, actions=plan)
        return tuple(candidates), descent.gradient_evaluations

    def _execute(self, result: StageResult, best: int) -> StageResult:
        """The stage with a plan executed, if it gains with its loss computed from scratch, too."""
        candidate, state = result.candidates[best], result.state_before
        start = state.with_tools(candidate.proposal.pose.unsqueeze(0))
        trajectory = self.full.simulator.rollout(start, candidate.actions.unsqueeze(0).to(state.position))
        result = dataclasses.replace(result, rollouts=result.rollouts + 1)
        if not is_finite(trajectory):
            return dataclasses.replace(result, status=Status.NON_FINITE)
        evaluated = self.full.objective.evaluate(trajectory)
        loss = float(evaluated.loss[0])
        if not loss < result.loss_before:
            return result
        return dataclasses.replace(
            result,
            status=Status.FINISHED,
            state=trajectory.final_state,
            best=best,
            actions=trajectory.actions[0],
            positions=trajectory.positions[0],
            tool_poses=trajectory.tool_poses[0],
            loss=loss,
            warm=evaluated.warm,
        )

    def _whole(self, candidate: Candidate) -> Candidate:
        """A candidate with the number that its contact particle has in the whole scene."""
        contact = candidate.proposal.contact_particle
        whole = None if contact is None else int(self.model.kept[contact])
        return dataclasses.replace(candidate, proposal=dataclasses.replace(candidate.proposal, contact_particle=whole))

    def _priorities(self, priorities: Tensor, state: State) -> Tensor:
        """Priorities (N,) of all particles: those of the nearest one that was kept."""
        from scipy.spatial import cKDTree

        position = state.position[0].detach().cpu().numpy()
        _, nearest = cKDTree(position[self.model.kept.cpu().numpy()]).query(position)
        return priorities[torch.as_tensor(np.asarray(nearest)).to(priorities.device)]
