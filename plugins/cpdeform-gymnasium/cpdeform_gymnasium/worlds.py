"""Worlds of one task on one simulator: stepped together, each reset on its own, in torch tensors."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from cpdeform.core.errors import InputError
from cpdeform.core.plugins import Registry, load_registry
from cpdeform.core.signed_distance import signed_distance
from cpdeform.core.simulator import Simulator, Trajectory
from cpdeform.core.state import State
from cpdeform.core.task import Task, changed_task, limited_task, load_task
from cpdeform.planning.metrics import goal_mass_grid
from cpdeform.planning.objectives.mass import mass_grid
from cpdeform.planning.objectives.metrics import soft_iou
from cpdeform_gymnasium.observation import OBSERVED_PARTICLES, Observation
from cpdeform_gymnasium.rewards import POINTS, MatchedTransport, Reward, make_reward

DIVERGENCE_PENALTY = 1.0
"""What a step costs whose simulation leaves the finite numbers: more than any W1 in the domain is likely to be."""

START_NOISE = 0.005
"""How far tools are shifted at the start of an episode, length units: a third of a grid cell."""

DRAWS = 20
"""Shifts that are tried before a tool is left where the scene has it."""

Info = dict[str, Tensor]


@dataclasses.dataclass(frozen=True)
class Snapshot:
    """A world at a moment, and what its episode began with; a copy, which can be pickled.

    Attributes:
        state: Particles and tools, a single world.
        start: Terms of the reward at the episode's start.
        start_iou: Soft IoU with the goal at the episode's start.
        random_state: State of the random generator that the next reset draws from; None where the world has none of its own.
    """

    state: State
    start: Mapping[str, float]
    start_iou: float
    random_state: Mapping[str, Any] | None = None


@dataclasses.dataclass(frozen=True)
class Step:
    """What a step of b worlds came to.

    Attributes:
        reward: Rewards (b,), float64, on the CPU.
        diverged: Worlds (b,) whose simulation left the finite numbers: they are where they were before the step.
        info: Values (b,) by name: ``"w1"`` (length units), ``"iou"``, ``"incremental_iou"`` and the reward's terms.
    """

    reward: Tensor
    diverged: Tensor
    info: Info


@dataclasses.dataclass(frozen=True)
class RewardGradient:
    """The rewards of a sequence of actions, and the gradient of their sum.

    Attributes:
        rewards: Rewards (B, T) after every step.
        gradient: Gradient (B, T, A) of the discounted sum of the rewards with respect to the actions.
    """

    rewards: Tensor
    gradient: Tensor


class Worlds:
    """B worlds of a task.

    Args:
        task: A task, a registered name, or the path of a YAML file.
        count: Number of worlds B.
        backend: Registered name of the simulator; ``"auto"`` is the fastest that is installed.
        device: ``"cpu"``, ``"cuda"`` or ``"cuda:N"``.
        reward: A reward, or a name of `make_reward`.
        observed_particles: Particles that an agent sees.
        points: Particles that W1 is computed on.
        start_noise: Standard deviation of the tools' start positions along each axis, length units, drawn anew by each reset. With
            0 every episode begins where the scene begins, and seeds change nothing.
        limits: Whether the limits that a task puts on its tools count.
        iou: Whether steps tell the IoU, which takes some milliseconds a world.
        scene: Changes of the task's scene, nested, as ``--set scene...`` takes them.
        simulator_options: Further keyword options of the simulator.
        simulator: A simulator of the task's scene with room for B worlds, in place of one by name.
        start: Where episodes begin, a single world; defaults to where the scene begins.
        registry: Where names are looked up; defaults to the installed plugins.

    Raises:
        InputError: An option or the task cannot be used.
        UnknownNameError: No plugin registers a name.
    """

    def __init__(
        self,
        task: Task | Path | str,
        *,
        count: int = 1,
        backend: str = "auto",
        device: str = "cpu",
        reward: Reward | str = "auto",
        observed_particles: int = OBSERVED_PARTICLES,
        points: int = POINTS,
        start_noise: float = START_NOISE,
        limits: bool = True,
        iou: bool = True,
        scene: Mapping[str, Any] | None = None,
        simulator_options: Mapping[str, Any] | None = None,
        simulator: Simulator | None = None,
        start: State | None = None,
        registry: Registry | None = None,
    ) -> None:
        if count < 1:
            raise InputError("num_envs", came=str(count), expected="at least 1")
        if not 0.0 <= start_noise < 1.0:
            raise InputError("start_noise", came=str(start_noise), expected="a length of at least 0 and below 1")
        registry = registry or load_registry()
        loaded = task if isinstance(task, Task) else load_task(task, registry=registry)
        loaded = limited_task(loaded) if limits else loaded.model_copy(update={"limits": {}})
        self.task = changed_task(loaded, scene=scene)
        self.count, self.start_noise, self.iou = count, start_noise, iou
        if simulator is None:
            name = registry.resolve("simulator", backend, device=device)
            options = {"batch_size": count, **(simulator_options or {})}
            simulator = registry.create("simulator", name, scene=self.task.scene, device=device, **options)
        elif simulator.scene != self.task.scene or simulator.batch_size < count:
            came = f"room for {simulator.batch_size}" if simulator.scene == self.task.scene else "one of another scene"
            raise InputError("simulator", came=came, expected=f"a simulator of the task's scene with room for {count} worlds")
        self.simulator: Simulator = simulator
        goal = torch.as_tensor(self.task.load_goal()).to(device=self.simulator.device, dtype=self.simulator.dtype)
        self.goal = goal
        self.observation = Observation(self.task.scene, particles=observed_particles)
        self.reward = reward if isinstance(reward, Reward) else make_reward(reward, self.task, goal, points=points)
        self._transport = MatchedTransport(self.task, goal, points=points)
        self._goal_grid = goal_mass_grid(self.task, goal.double())
        self._goal_iou = float(soft_iou(self._goal_grid, self._goal_grid))
        begun = self.simulator.initial_state(batch_size=1) if start is None else start
        self._template = begun.to(device=self.simulator.device, dtype=self.simulator.dtype)
        self.state = self._template.fork(count)
        terms = self.reward.terms(self.state.position, self.state.tool_pose)
        self._start: Info = {key: value.detach().clone() for key, value in terms.items()}
        self._template_iou = float(self._iou(self._template.position)[0])
        self._start_iou = torch.full((count,), self._template_iou, dtype=torch.float64, device=self.simulator.device)

    def reset(self, world: int, *, generator: np.random.Generator) -> None:
        """Put a world back to the start of an episode; the others stay as they are.

        Args:
            world: Which one.
            generator: Where the tools' start positions are drawn from.
        """
        start = self._template.with_tools(self._start_poses(generator).unsqueeze(0))
        with torch.no_grad():
            terms = self.reward.terms(start.position, start.tool_pose)
        found = {name: float(value[0]) for name, value in terms.items()}
        self.restore(world, Snapshot(start, found, self._template_iou))

    def observe(self) -> Tensor:
        """Observations (B, O) of all worlds."""
        return self.observation.observe(self.state)

    def step(self, actions: Tensor, worlds: Sequence[int] | None = None) -> Step:
        """Take one environment step; nothing is kept for a gradient.

        Args:
            actions: Actions (b, A) in [-1, 1].
            worlds: The b worlds that take it, in ascending order; defaults to all. The others stay as they are.

        Raises:
            InputError: An action is not finite, or outside [-1, 1].
        """
        chosen = list(range(self.count)) if worlds is None else list(worlds)
        before = self.state if len(chosen) == self.count else self.state.map(lambda tensor: tensor[chosen])
        trajectory = self.simulator.simulate(before, actions.unsqueeze(1).to(before.position))
        after, diverged = _held(before, trajectory)
        self.state = after if len(chosen) == self.count else _replaced(self.state, chosen, after)
        start = {name: value[chosen] for name, value in self._start.items()}
        with torch.no_grad():
            terms = self.reward.terms(after.position, after.tool_pose)
            reward = self.reward.combine(terms, start).double().cpu() - DIVERGENCE_PENALTY * diverged
            info = {**terms, **self._measures(after.position, terms, self._start_iou[chosen])}
        return Step(reward, diverged, {name: value.double().cpu() for name, value in info.items()})

    def rollout_gradient(self, actions: Tensor, *, discount: float = 1.0) -> RewardGradient:
        """Rewards of actions from where the worlds are, and the gradient of their sum; the worlds stay where they are.

        Args:
            actions: Actions (B, T, A) in [-1, 1].
            discount: Factor of the reward of step t = 1..T, to the power t - 1.

        Raises:
            InputError: The shape does not fit, or an action is not finite or outside [-1, 1].
            CapabilityError: The simulator has no gradient.
        """
        trajectory = self.simulator.rollout(self.state, actions.to(self.state.position))
        rewards = []
        grad_positions = torch.zeros_like(trajectory.positions)
        grad_poses = torch.zeros_like(trajectory.tool_poses)
        # Moment by moment: the graph of a single one is held at a time.
        for step in range(1, trajectory.step_count + 1):
            positions = trajectory.positions[:, step].detach().requires_grad_()
            poses = trajectory.tool_poses[:, step].detach().requires_grad_()
            with torch.enable_grad():
                reward = self.reward.combine(self.reward.terms(positions, poses), self._start)
                slopes = torch.autograd.grad(reward.sum(), [positions, poses], allow_unused=True)
            rewards.append(reward.detach())
            for whole, slope in zip((grad_positions, grad_poses), slopes, strict=True):
                if slope is not None:
                    whole[:, step] = discount ** (step - 1) * slope
        gradient = self.simulator.vjp(trajectory, grad_positions, grad_poses).actions
        return RewardGradient(torch.stack(rewards, dim=1), gradient)

    def start_terms(self) -> Info:
        """The reward's terms (B,) at the start of each world's episode."""
        return {name: value.clone() for name, value in self._start.items()}

    def snapshot(self, world: int) -> Snapshot:
        """A copy of all of a world."""
        start = {name: float(value[world]) for name, value in self._start.items()}
        return Snapshot(self.state.select(world).clone(), start, float(self._start_iou[world]))

    def restore(self, world: int, snapshot: Snapshot) -> None:
        """Put a world to where it was; the others stay as they are.

        Raises:
            InputError: The snapshot is one of another scene.
        """
        came, expected = snapshot.state.particle_count, self.task.scene.particle_count
        if came != expected or snapshot.start.keys() != self._start.keys():
            text = f"a state of {came} particles with the reward's terms {', '.join(snapshot.start)}"
            raise InputError(
                "state", came=text, expected=f"{expected} particles and the terms {', '.join(self._start)}",
                remedy="Take it from an environment of the same task with the same reward.",
            )  # fmt: skip
        self.state = _replaced(self.state, [world], snapshot.state.to(device=self.simulator.device, dtype=self.simulator.dtype))
        for name, value in snapshot.start.items():
            self._start[name] = self._start[name].clone()
            self._start[name][world] = value
        self._start_iou = self._start_iou.clone()
        self._start_iou[world] = snapshot.start_iou

    def measures(self) -> Info:
        """The values of `Step.info` (B,) for the worlds as they are."""
        with torch.no_grad():
            terms = self.reward.terms(self.state.position, self.state.tool_pose)
            found = {**terms, **self._measures(self.state.position, terms, self._start_iou)}
        return {name: value.double().cpu() for name, value in found.items()}

    def _start_poses(self, generator: np.random.Generator) -> Tensor:
        """Tool poses (M, 8) of an episode's start, movable tools shifted within their bounds and free of the clay."""
        poses: Tensor = self._template.tool_pose[0].clone()
        for index, tool in enumerate(self.task.scene.tools):
            if not tool.movable or self.start_noise == 0.0:
                continue
            lower, upper = poses.new_tensor(tool.lower_bound), poses.new_tensor(tool.upper_bound)
            least = min(0.0, self._gap(index, poses[index]))
            for attempt in range(DRAWS):
                # Where there is hardly any room, smaller shifts are tried.
                shift = torch.as_tensor(generator.normal(size=3)).to(poses) * self.start_noise / (1 + attempt // 4)
                drawn = poses[index].clone()
                drawn[:3] = (drawn[:3] + shift).clamp(lower, upper)
                if self._gap(index, drawn) >= least:
                    poses[index] = drawn
                    break
        return poses

    def _gap(self, tool: int, pose: Tensor) -> float:
        """Signed distance between a tool and the clay at the start, length units."""
        return float(signed_distance(self.task.scene.tools[tool], pose, self._template.position[0]).min())

    def _measures(self, positions: Tensor, terms: Info, start_iou: Tensor) -> Info:
        found = {} if "w1" in terms else {"w1": self._transport.distance(positions)}
        if self.iou:
            iou = self._iou(positions)
            found |= {"iou": iou, "incremental_iou": ((iou - start_iou) / (self._goal_iou - start_iou)).clamp(0.0, 1.0)}
        return found

    def _iou(self, positions: Tensor) -> Tensor:
        """Soft IoU (b,) with the goal."""
        grids: list[Tensor] = [mass_grid(world.double(), self.task.scene) for world in positions]
        return torch.stack([soft_iou(grid, self._goal_grid) for grid in grids])


def _held(before: State, trajectory: Trajectory) -> tuple[State, Tensor]:
    """The state after a step, worlds that left the finite numbers put back, and which worlds (b,) they are."""
    after = trajectory.final_state
    tensors = (after.position, after.velocity, after.affine, after.elastic_strain, after.tool_pose)
    finite = torch.stack([torch.isfinite(tensor).flatten(1).all(dim=1) for tensor in tensors]).all(dim=0)
    if not bool(finite.all()):
        broken = torch.nonzero(~finite).flatten().tolist()
        after = _replaced(after, broken, before.map(lambda tensor: tensor[broken]))
    return after, torch.logical_not(finite).cpu()


def _replaced(state: State, worlds: Sequence[int], by: State) -> State:
    """A state with some worlds replaced."""
    index = torch.as_tensor(list(worlds), device=state.position.device)
    names = [field.name for field in dataclasses.fields(State)]
    return State(**{name: getattr(state, name).index_copy(0, index, getattr(by, name)) for name in names})
