"""A coarser model of a scene: most touches are dropped, and a coarse rollout is enough to see which."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import torch
from torch import Tensor

from cpdeform.core.clearance import tool_half_extents
from cpdeform.core.objective import ObjectiveResult
from cpdeform.core.placer import Candidate
from cpdeform.core.scene import WALL_NODES, Scene, Tool
from cpdeform.core.simulator import Simulator
from cpdeform.core.state import State
from cpdeform.planning.objectives.shape import ObjectiveShape
from cpdeform.planning.optimizer import OptimizationResult, TrajectoryOptimizer
from cpdeform.planning.still import still_trajectory
from cpdeform.planning.workbench import Workbench

PARTICLES_PER_CELL = 1.7
"""Particles per cell of the grid that are kept where the grid stays. Of 64 touches on `star`, whose 10,000 particles fill a cell by
6.7, a quarter of them ranks the losses as all do (Spearman 0.92), in a third of the time."""

GRID_FACTOR = 2
"""How many times wider the cells of a coarse grid are. The time step grows by as much, and an eighth of the particles fills the
cells as before: a gradient costs a twelfth. On a generated goal of `star` its cosine with the fine one was 0.5 to 0.9 for the best
six of 32 touches, and their losses have a rank correlation of 0.75."""

LEAST_TOOL, LEAST_BODY = 0.75, 2.0
"""How thick a tool, half of it, and a body have to be for a coarse grid, in its cells."""

LEAST_PARTICLES = 500
"""Particles that a coarse grid is worth while for."""


@dataclasses.dataclass(frozen=True)
class CoarseScene:
    """A scene with fewer particles, maybe on a coarser grid.

    Attributes:
        scene: The coarse scene.
        factor: Every how many-th particle of each body is kept.
        lift: How much higher its floor lies, length units: a floor is as high as a number of nodes.
    """

    scene: Scene
    factor: int
    lift: float = 0.0


@dataclasses.dataclass(kw_only=True)
class CoarseModel:
    """Every k-th particle of a scene, on its grid or on a coarser one.

    A particle's mass and volume stay as they are, and so does the motion of the clay: only their ratio counts.

    Attributes:
        simulator: Simulates the coarse scene.
        objective: The loss for it.
        kept: Indices (n,) of the particles that are kept.
        lift: How much higher the coarse scene's floor lies, length units.
    """

    simulator: Simulator
    objective: ObjectiveShape
    kept: Tensor
    lift: float = 0.0
    _still: tuple[State, ObjectiveResult] | None = None

    @classmethod
    def of(cls, simulator: Simulator, objective: ObjectiveShape) -> CoarseModel | None:
        """The coarse model of a simulator's scene; None where its particles are few already.

        Args:
            simulator: Simulates the scene.
            objective: The loss for it.
        """
        scene = simulator.scene
        coarse = on_coarser_grid(scene)
        if coarse is None or not _within_walls(coarse, objective):
            coarse = with_fewer_particles(scene)
        if coarse is None:
            return None
        parts, first = list[Tensor](), 0
        for body in scene.bodies:
            parts.append(torch.arange(first, first + body.particle_count, coarse.factor))
            first += body.particle_count
        kept = torch.cat(parts).to(simulator.device)
        # A goal of corresponding particles stays one: the same are kept of both. Of any other, as many are enough as of the clay.
        goal = objective.goal[kept] if len(objective.goal) == scene.particle_count else objective.goal[:: coarse.factor]
        rise = objective.goal.new_tensor([0.0, coarse.lift, 0.0])
        return cls(
            simulator=simulator.for_scene(coarse.scene),
            objective=objective.rebased(goal=goal + rise, start=objective.start[kept] + rise, scene=coarse.scene),
            kept=kept,
            lift=coarse.lift,
        )

    def thinned(self, state: State) -> State:
        """A state with the kept particles alone, on the coarse scene's floor."""
        fields = ("position", "velocity", "affine", "elastic_strain")
        kept = {name: getattr(state, name)[:, self.kept].contiguous() for name in fields}
        kept["position"] = self._lifted(kept["position"])
        return dataclasses.replace(state, **kept, tool_pose=self._lifted(state.tool_pose))

    def rollout_losses(self, bench: Workbench, candidates: Sequence[Candidate], *, phase: str) -> Tensor:
        """Losses (B,) of the candidates' actions; nan where one is not finite.

        A coarse loss is another one. So what is returned is the loss of the stage's state plus the change of the coarse loss.

        Args:
            bench: The stage with all particles; the rollouts are counted there.
            candidates: Candidates with actions.
            phase: Name of the phase that asks.
        """
        coarse, offset = self._bench(bench)
        losses = coarse.rollout_losses(self._moved(candidates), None, phase=phase)
        bench.rollouts += coarse.rollouts
        return losses + offset

    def minimize(
        self, bench: Workbench, candidates: Sequence[Candidate], optimizer: TrajectoryOptimizer, *, phase: str
    ) -> OptimizationResult:
        """Minimise the coarse loss over the actions of candidates; the losses are returned as `rollout_losses` does.

        Args:
            bench: The stage with all particles. A gradient on a coarse grid costs less than a rollout there, and counts as one.
            candidates: Candidates with actions.
            optimizer: How.
            phase: Name of the phase that asks.
        """
        coarse, offset = self._bench(bench)
        try:
            found = coarse.minimize(self._moved(candidates), optimizer, None, phase=phase)
        finally:
            bench.rollouts += coarse.gradient_evaluations
        return dataclasses.replace(found, loss=found.loss + offset)

    def _bench(self, bench: Workbench) -> tuple[Workbench, float]:
        """The stage on the coarse scene, and what its losses are short of those with all particles."""
        state, still = self._of_stage(bench)
        coarse = dataclasses.replace(
            bench,
            stage=dataclasses.replace(bench.stage, state=state),
            simulator=self.simulator,
            objective=self.objective,
            warm=still.warm,
            rollouts=0,
            gradient_evaluations=0,
            racing=None,
        )
        return coarse, bench.stage.loss - float(still.loss[0])

    def _moved(self, candidates: Sequence[Candidate]) -> list[Candidate]:
        """Candidates with their tools as high above the coarse scene's floor as above that of the scene."""
        return [
            dataclasses.replace(
                candidate, proposal=dataclasses.replace(candidate.proposal, pose=self._lifted(candidate.proposal.pose))
            )
            for candidate in candidates
        ]

    def _of_stage(self, bench: Workbench) -> tuple[State, ObjectiveResult]:
        """The stage's state with fewer particles, and its loss where nothing moves; kept for the phases of a stage."""
        if self._still is None or self._still[0] is not bench.stage.state:
            thin = self.thinned(bench.stage.state)
            trajectory = still_trajectory(thin, bench.task.rollout_steps, scene=self.simulator.scene)
            self._still = (bench.stage.state, self.objective.evaluate(trajectory))
        return self.thinned(bench.stage.state), self._still[1]

    def _lifted(self, vectors: Tensor) -> Tensor:
        """Positions or poses (..., 3 or more), higher by the lift."""
        lifted = vectors.clone()
        lifted[..., 1] += self.lift
        return lifted


def on_coarser_grid(scene: Scene) -> CoarseScene | None:
    """A scene on a grid of wider cells, and with as few particles as fill them alike.

    Returns:
        The coarse scene; None where tools or clay would be thinner than its cells can show, or the particles are few.
    """
    nodes, factor = scene.grid_size // GRID_FACTOR, GRID_FACTOR**3
    upright = torch.tensor([1.0, 0.0, 0.0, 0.0])
    tool = min((float(tool_half_extents(tool, upright).min()) for tool in scene.tools if tool.movable), default=0.0)
    body = 2.0 * min(min(body.half_extents) for body in scene.bodies)
    thick = tool * nodes >= LEAST_TOOL and body * nodes >= LEAST_BODY
    if scene.grid_size % GRID_FACTOR or not thick or scene.particle_count < factor * LEAST_PARTICLES:
        return None
    height = max(0, math.ceil(scene.resting_height * nodes - 1e-9) - WALL_NODES)
    substeps = math.ceil(scene.substeps / GRID_FACTOR)
    changes = {
        "grid_size": nodes,
        # Half a node more, so that rounding does not take one away.
        "ground_height": (height + 0.5) / nodes if height else 0.0,
        "substeps": substeps,
        "time_step": scene.time_step * scene.substeps / substeps,
    }
    coarse = _thinned_scene(scene, factor).model_copy(update=changes)
    lift = coarse.resting_height - scene.resting_height
    raised = tuple(_raised(tool, lift) for tool in scene.tools)
    return CoarseScene(coarse.model_copy(update={"tools": raised}), factor, lift)


def _within_walls(coarse: CoarseScene, objective: ObjectiveShape) -> bool:
    """Whether clay and goal are free of the walls, whose layers of nodes are wider on a coarse grid."""
    wall = WALL_NODES * coarse.scene.node_distance
    clouds = torch.cat([objective.start, objective.goal.to(objective.start)])
    level, top = clouds[:, [0, 2]], clouds[:, 1].max() + coarse.lift
    return bool((level >= wall).all() and (level <= 1.0 - wall).all() and top <= 1.0 - wall)


def with_fewer_particles(scene: Scene) -> CoarseScene | None:
    """A scene with fewer particles on its grid; None where they are few already."""
    factor = coarsening(scene)
    return None if factor < 2 else CoarseScene(_thinned_scene(scene, factor), factor)


def coarsening(scene: Scene) -> int:
    """How many particles of a scene one stands for on the same grid; 1 for none to be dropped."""
    cells = sum(body.volume for body in scene.bodies) * scene.grid_size**3
    return max(1, round(scene.particle_count / max(cells, 1.0) / PARTICLES_PER_CELL))


def _thinned_scene(scene: Scene, factor: int) -> Scene:
    """The scene with every `factor`-th particle of each body."""
    bodies = [body.model_copy(update={"particle_count": math.ceil(body.particle_count / factor)}) for body in scene.bodies]
    return scene.model_copy(update={"bodies": tuple(bodies)})


def _raised(tool: Tool, lift: float) -> Tool:
    """A tool whose bounds are higher."""
    bounds = {name: getattr(tool, name) for name in ("lower_bound", "upper_bound")}
    return tool.model_copy(update={name: (x, y + lift, z) for name, (x, y, z) in bounds.items()})
