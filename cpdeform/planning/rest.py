"""Clay that comes to rest: what is left of a shape when the tools are away and nothing moves any more.

Clay bounces for hundreds of environment steps, since the simulator loses energy slowly where nothing yields. Kinetic damping, a
method of dynamic relaxation [1]_, ends that: whenever the kinetic energy has passed a peak, velocities are set to zero, so that
the clay sets out again from near its equilibrium. Taken from the beginning it would change the result, since impacts and the first
bounces deform clay for good. So it begins only when the kinetic energy is far below the elastic energy at which clay yields.

Measured with 10,000 particles of `star` in float32, which fall from 0.02 above the floor: 140 to 165 steps instead of 390, and the
rest is that of plain waiting with a volume IoU of 1.000 and a mean distance of 0.0006 cells. Damped from the third peak on, however
high, the IoU was 0.983; from the first on, 0.982 (3,000 particles).

References:
    .. [1] Cundall, "Explicit finite-difference methods in geomechanics", Numerical Methods in Geomechanics, 1976.
"""

from __future__ import annotations

import dataclasses
import math

import torch
from torch import Tensor

from cpdeform.core.errors import InputError
from cpdeform.core.sampling import body_index
from cpdeform.core.scene import Scene
from cpdeform.core.signed_distance import signed_distance
from cpdeform.core.simulator import Simulator
from cpdeform.core.state import State, initial_state
from cpdeform.planning.shape_metrics import GoalShape

TOLERANCE = 1e-4
"""Motion of a particle at rest, in cells per environment step, at most."""

STEP_LIMIT = 500
"""Environment steps after which clay that still moves is given up."""

CALM_STEPS = 5
"""Steps in a row without motion that make a rest: at the turning points of a vibration nothing moves for a moment."""

DAMPED_ENERGY = 0.01
"""Kinetic energy below which clay is damped, over the elastic energy at which it yields."""

STRAY_SHARE = 0.005
"""Share of the particles that may go on moving: single crumbs slide down a flank for thousands of steps. Of a slab of `star` that
was squeezed hard it is 0.003 after 150 steps, when half of the particles do not move at all, and still 0.0016 after 500."""

CLEARANCE = 0.02
"""Distance from all clay that a tool is taken to, length units; beyond 0.0035 a tool of the usual softness acts on nothing."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Rest:
    """B worlds that were left alone.

    Attributes:
        state: Their state, tools where they were before; velocities and affine velocities are zero in worlds at rest.
        steps: Environment steps (B,) that each took.
        rests: Whether each (B,) came to rest within the limit: no particle moves, but for the stray ones.
        residual: Motion (B,) of the fastest particle in the last step, cells per environment step.
        moving_share: Share (B,) of the particles that moved more than the tolerance in the last step.
    """

    state: State
    steps: tuple[int, ...]
    rests: tuple[bool, ...]
    residual: tuple[float, ...]
    moving_share: tuple[float, ...]


@dataclasses.dataclass(frozen=True, kw_only=True)
class SettledGoal:
    """A goal, put where clay of its shape comes to rest.

    Attributes:
        position: The goal's particles (M, 3), moved straight down and not deformed, length units.
        drop: How far they were moved down, length units: the mean over the particles when they were let go as clay, but not below
            the ground.
        let_go: Where they came to rest as clay (M, 3), length units.
        self_iou: Volume IoU of these two: 1 for a shape that clay keeps, less for one that sags or falls apart, 0 for one whose
            clay left the finite numbers.
        steps: Environment steps until they rested.
        rests: Whether they did within the limit.
        residual: Motion of the fastest particle in the last step, cells per environment step.
    """

    position: Tensor
    drop: float
    let_go: Tensor
    self_iou: float
    steps: int
    rests: bool
    residual: float


def rest(
    simulator: Simulator,
    state: State,
    *,
    step_limit: int = STEP_LIMIT,
    tolerance: float = TOLERANCE,
    stray_share: float = STRAY_SHARE,
    damped: bool = True,
) -> Rest:
    """Leave clay alone until it does not move any more, its tools out of the way.

    Movable tools are put at a free place within their bounds, high above the clay where they may go there, and back to their poses
    at the end. The clay is simulated an environment step at a time, without anything kept for gradients.

    Args:
        simulator: A simulator of the scene.
        state: B worlds, at most the simulator's batch size; not modified.
        step_limit: Environment steps, at most.
        tolerance: Motion of a particle at rest, cells per environment step, at most.
        stray_share: Share of the particles that may go on moving; 0 waits for every single one.
        damped: Whether to use kinetic damping once the clay moves too little to yield; plain waiting ends at the same rest.

    Returns:
        The worlds at rest, or as they are after `step_limit` steps.

    Raises:
        InputError: An option is out of range, or a tool finds no place free of clay within its bounds.
    """
    _check_options(step_limit=step_limit, tolerance=tolerance, stray_share=stray_share)
    worlds = state.batch_size
    current = state.with_tools(tools_away(state, simulator.scene)).to(device=simulator.device, dtype=simulator.dtype).clone()
    relaxations = [_Relaxation(simulator.scene) for _ in range(worlds)]
    active = list(range(worlds))
    for _ in range(step_limit):
        before = current.map(lambda tensor: tensor[active])  # noqa: B023 - called at once
        actions = before.position.new_zeros(len(active), 1, simulator.scene.action_size)
        after = simulator.rollout(before, actions).final_state
        motion = (after.position - before.position).norm(dim=-1) * simulator.scene.grid_size
        current.position[active], current.elastic_strain[active] = after.position, after.elastic_strain
        for row, world in enumerate(active):
            damping = relaxations[world].advance(motion[row], after.velocity[row], tolerance, stray_share, damped=damped)
            still = damping if not relaxations[world].rests else torch.ones_like(damping)
            current.velocity[world] = torch.where(still[:, None], 0.0, after.velocity[row])
            current.affine[world] = torch.where(still[:, None, None], 0.0, after.affine[row])
        # A world that has left the finite numbers cannot go on, and does not rest.
        active = [world for world in active if not relaxations[world].rests and _is_finite(current, world)]
        if not active:
            break
    return Rest(
        state=current.to(device=state.position.device, dtype=state.position.dtype).with_tools(state.tool_pose),
        steps=tuple(item.steps for item in relaxations),
        rests=tuple(item.rests for item in relaxations),
        residual=tuple(item.residual for item in relaxations),
        moving_share=tuple(item.moving_share for item in relaxations),
    )


def _is_finite(state: State, world: int) -> bool:
    tensors = (state.position, state.velocity, state.affine, state.elastic_strain)
    return all(bool(torch.isfinite(tensor[world]).all()) for tensor in tensors)


class _Relaxation:
    """What is known of a world while it comes to rest, and when to damp it."""

    def __init__(self, scene: Scene) -> None:
        self.steps, self.calm, self.residual, self.moving_share = 0, 0, float("inf"), 1.0
        self._energy, self._rising = 0.0, True
        materials = [scene.material_of(body) for body in range(len(scene.bodies))]
        # Deviatoric elastic energy at yield, per mass (density 1): mu |e|^2 with |e| = yield stress / (2 mu).
        energies = torch.tensor([item.yield_stress**2 / (4.0 * item.shear_modulus) for item in materials], dtype=torch.float64)
        self._limit = DAMPED_ENERGY * energies[torch.as_tensor(body_index(scene), dtype=torch.long)]

    @property
    def rests(self) -> bool:
        """Whether nothing has moved for long enough."""
        return self.calm >= CALM_STEPS

    def advance(self, motion: Tensor, velocity: Tensor, tolerance: float, stray_share: float, *, damped: bool) -> Tensor:
        """Take note of a step.

        Args:
            motion: How far each particle (N,) moved, cells.
            velocity: Velocities (N, 3) after it, length/second.
            tolerance: As for `rest`.
            stray_share: As for `rest`.
            damped: As for `rest`.

        Returns:
            Which particles (N,) are to be stopped.
        """
        self.steps += 1
        self.residual = float(motion.max())
        self.moving_share = float((motion > tolerance).double().mean())
        # The largest of numbers with a nan among them is nan: no rest.
        calm = self.residual <= tolerance or (math.isfinite(self.residual) and self.moving_share <= stray_share)
        self.calm = self.calm + 1 if calm else 0
        ratio = 0.5 * velocity.double().square().sum(dim=-1) / self._limit.to(velocity.device)
        energy = float(ratio.mean())
        peaked = self._rising and energy < self._energy
        self._rising, self._energy = energy >= self._energy, energy
        stopped = torch.zeros_like(ratio, dtype=torch.bool)
        if damped and peaked and energy < 1.0:
            # A crumb that falls is not stopped with the body: it would hang in the air.
            stopped = ratio < 1.0
            self._rising, self._energy = True, float(torch.where(stopped, 0.0, ratio).mean())
        return stopped


def tools_away(state: State, scene: Scene) -> Tensor:
    """Tool poses (B, M, 8) in which no movable tool is near the clay; fixed tools stay.

    Args:
        state: B worlds.
        scene: Its tools' bounds limit where they can go: a step of the simulator would move them back within these.

    Raises:
        InputError: A tool has no place within its bounds that is free of clay.
    """
    poses = state.tool_pose.clone()
    for index, tool in enumerate(scene.tools):
        if not tool.movable:
            continue
        lower, upper = tool.lower_bound, tool.upper_bound
        corners = [(x, y, z) for y in (upper[1], lower[1]) for x in (lower[0], upper[0]) for z in (lower[2], upper[2])]
        for world in range(state.batch_size):
            places = poses[world, index].repeat(len(corners) + 1, 1)
            places[0, 1] = upper[1]
            places[1:, :3] = torch.tensor(corners).to(places)
            distances = signed_distance(tool, places, state.position[world]).amin(dim=-1)
            free = torch.nonzero(distances > CLEARANCE).flatten()
            if not len(free):
                raise InputError(
                    f"state: tools.{index}",
                    came=f"clay within {CLEARANCE} of every corner of its bounds",
                    expected="a place free of clay",
                    remedy="Use a simulator of rest_scene(scene), which has no movable tools.",
                )
            poses[world, index] = places[int(free[0])]
    return poses


def rest_scene(scene: Scene, *, particle_count: int | None = None) -> Scene:
    """The scene without its movable tools, to let clay rest in.

    Args:
        scene: The scene.
        particle_count: Another number of particles M, at least one a body, shared out among the bodies in proportion.

    Raises:
        InputError: `particle_count` is below the number of bodies.
    """
    tools = tuple(tool for tool in scene.tools if not tool.movable)
    changed = scene.model_copy(update={"tools": tools})
    if particle_count is None or particle_count == scene.particle_count:
        return changed
    if particle_count < len(scene.bodies):
        raise InputError("particle_count", came=str(particle_count), expected=f"at least {len(scene.bodies)}, one a body")
    bodies, left, weight = [], particle_count, scene.particle_count
    for number, body in enumerate(scene.bodies, start=1):
        others = len(scene.bodies) - number
        share = min(max(1, round(left * body.particle_count / weight)), left - others)
        bodies.append(body.model_copy(update={"particle_count": share}))
        left, weight = left - share, weight - body.particle_count
    return changed.model_copy(update={"bodies": tuple(bodies)})


def rest_state(state: State, scene: Scene) -> State:
    """A state of `scene` as one of `rest_scene(scene)`: the poses of its fixed tools alone."""
    fixed = [index for index, tool in enumerate(scene.tools) if not tool.movable]
    return state.with_tools(state.tool_pose[:, fixed])


def settle_goal(
    simulator: Simulator,
    goal: Tensor,
    *,
    step_limit: int = STEP_LIMIT,
    tolerance: float = TOLERANCE,
    stray_share: float = STRAY_SHARE,
    damped: bool = True,
) -> SettledGoal:
    """Let a goal's particles go as undeformed clay and put the goal where they come to rest.

    Args:
        simulator: A simulator of the scene with as many particles as the goal, such as one of `rest_scene`.
        goal: Goal particles (M, 3), length units; not modified.
        step_limit: As for `rest`.
        tolerance: As for `rest`.
        stray_share: As for `rest`.
        damped: As for `rest`.

    Raises:
        InputError: `goal` does not fit the simulator, or an option is out of range.
    """
    count = simulator.scene.particle_count
    if goal.shape != (count, 3):
        raise InputError(
            "goal",
            came=f"shape {tuple(goal.shape)}",
            expected=f"shape ({count}, 3), the particles of the simulator's scene",
            remedy="Make a simulator of rest_scene(scene, particle_count=len(goal)).",
        )
    start = initial_state(simulator.scene, device=simulator.device, dtype=simulator.dtype)
    start = dataclasses.replace(start, position=goal.detach().to(start.position).unsqueeze(0).contiguous())
    found = rest(simulator, start, step_limit=step_limit, tolerance=tolerance, stray_share=stray_share, damped=damped)
    let_go = found.state.position[0].to(goal)
    if not bool(torch.isfinite(let_go).all()):
        return SettledGoal(
            position=goal.detach().clone(),
            drop=0.0,
            let_go=let_go,
            self_iou=0.0,
            steps=found.steps[0],
            rests=False,
            residual=found.residual[0],
        )
    # A shape that collapses sinks farther on average than it can be put down whole.
    room = float(goal[:, 1].min()) - simulator.scene.domain[0][1]
    drop = min(float((goal - let_go)[:, 1].double().mean()), max(room, 0.0))
    moved = goal.detach().clone()
    moved[:, 1] -= drop
    return SettledGoal(
        position=moved,
        drop=drop,
        let_go=let_go,
        self_iou=GoalShape(moved, simulator.scene).iou(let_go),
        steps=found.steps[0],
        rests=found.rests[0],
        residual=found.residual[0],
    )


def _check_options(*, step_limit: int, tolerance: float, stray_share: float) -> None:
    if step_limit < 1:
        raise InputError("step_limit", came=str(step_limit), expected="at least 1 environment step")
    if not tolerance > 0.0:
        raise InputError("tolerance", came=str(tolerance), expected="a positive motion, in cells per environment step")
    if not 0.0 <= stray_share < 1.0:
        raise InputError("stray_share", came=str(stray_share), expected="a share of at least 0 and below 1")
