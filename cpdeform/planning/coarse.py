"""A scene with fewer particles, for screening: most touches are dropped, and a coarse rollout is enough to see which."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import torch
from torch import Tensor

from cpdeform.core.objective import ObjectiveResult
from cpdeform.core.placer import Candidate
from cpdeform.core.scene import Scene
from cpdeform.core.simulator import Simulator
from cpdeform.core.state import State
from cpdeform.planning.objectives.shape import ObjectiveShape
from cpdeform.planning.still import still_trajectory
from cpdeform.planning.workbench import Workbench

PARTICLES_PER_CELL = 1.7
"""Particles per cell of the grid that a coarse scene keeps. Of 64 touches on `star`, whose 10,000 particles fill a cell by 6.7, a
quarter of them ranks the losses as all do (Spearman 0.92), in a third of the time. Their gradients point elsewhere: the cosine with
those of all particles was 0.97, 0.81, 0.80 and -0.27 for four touches."""


@dataclasses.dataclass(kw_only=True)
class CoarseModel:
    """Every k-th particle of a scene. A particle's mass and volume stay as they are, and so does the motion of the clay.

    Attributes:
        simulator: Simulates the coarse scene.
        objective: The loss for it.
        kept: Indices (n,) of the particles that are kept.
    """

    simulator: Simulator
    objective: ObjectiveShape
    kept: Tensor
    _still: tuple[State, ObjectiveResult] | None = None

    @classmethod
    def of(cls, simulator: Simulator, objective: ObjectiveShape) -> CoarseModel | None:
        """The coarse model of a simulator's scene; None where its particles are few already.

        Args:
            simulator: Simulates the scene.
            objective: The loss for it.
        """
        scene = simulator.scene
        factor = coarsening(scene)
        if factor < 2:
            return None
        bodies, parts, first = [], list[Tensor](), 0
        for body in scene.bodies:
            parts.append(torch.arange(first, first + body.particle_count, factor))
            bodies.append(body.model_copy(update={"particle_count": len(parts[-1])}))
            first += body.particle_count
        kept = torch.cat(parts).to(simulator.device)
        # A goal of corresponding particles stays one: the same are kept of both.
        goal = objective.goal[kept] if len(objective.goal) == scene.particle_count else objective.goal
        return cls(
            simulator=simulator.for_scene(scene.model_copy(update={"bodies": tuple(bodies)})),
            objective=objective.rebased(goal=goal, start=objective.start[kept]),
            kept=kept,
        )

    def thinned(self, state: State) -> State:
        """A state with the kept particles alone."""
        fields = ("position", "velocity", "affine", "elastic_strain")
        return dataclasses.replace(state, **{name: getattr(state, name)[:, self.kept].contiguous() for name in fields})

    def rollout_losses(self, bench: Workbench, candidates: Sequence[Candidate], *, phase: str) -> Tensor:
        """Losses (B,) of the candidates' actions; nan where one is not finite.

        Fewer particles have a higher loss. So what is returned is the loss of the stage's state plus the change of the coarse loss.

        Args:
            bench: The stage with all particles; the rollouts are counted there.
            candidates: Candidates with actions.
            phase: Name of the phase that asks.
        """
        state, still = self._of_stage(bench)
        coarse = dataclasses.replace(
            bench,
            stage=dataclasses.replace(bench.stage, state=state),
            simulator=self.simulator,
            objective=self.objective,
            warm=still.warm,
            rollouts=0,
        )
        losses = coarse.rollout_losses(candidates, None, phase=phase)
        bench.rollouts += coarse.rollouts
        return losses + (bench.stage.loss - float(still.loss[0]))

    def _of_stage(self, bench: Workbench) -> tuple[State, ObjectiveResult]:
        """The stage's state with fewer particles, and its loss where nothing moves; kept for the rounds of a stage."""
        if self._still is None or self._still[0] is not bench.stage.state:
            thin = self.thinned(bench.stage.state)
            trajectory = still_trajectory(thin, bench.task.rollout_steps, scene=self.simulator.scene)
            self._still = (bench.stage.state, self.objective.evaluate(trajectory))
        return self.thinned(bench.stage.state), self._still[1]


def coarsening(scene: Scene) -> int:
    """How many particles of a scene one stands for in its coarse model; 1 for none to be dropped."""
    cells = sum(body.volume for body in scene.bodies) * scene.grid_size**3
    return max(1, round(scene.particle_count / max(cells, 1.0) / PARTICLES_PER_CELL))
