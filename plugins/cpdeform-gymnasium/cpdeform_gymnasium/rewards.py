"""Rewards: the paper's, and PlasticineLab's own."""

from __future__ import annotations

import abc
from collections.abc import Mapping

import torch
from torch import Tensor

from cpdeform.core.errors import InputError
from cpdeform.core.scene import Scene
from cpdeform.core.signed_distance import signed_distance
from cpdeform.core.task import Task
from cpdeform.planning.metrics import goal_mass_grid
from cpdeform.planning.objectives.plasticinelab import ObjectivePlasticineLab

POINTS = 400
"""Particles that W1 is computed on."""

PLASTICINELAB_TASKS = ("pinch",)
"""Tasks for which the paper takes PlasticineLab's reward."""


class Reward(abc.ABC):
    """A reward of single moments; each world is independent of the others, and nothing is kept between calls."""

    @abc.abstractmethod
    def terms(self, positions: Tensor, poses: Tensor) -> dict[str, Tensor]:
        """What the reward is made of, for `info`, too.

        Args:
            positions: Particle positions (B, N, 3), length units.
            poses: Tool poses (B, M, 8).

        Returns:
            Values (B,) by name, differentiable with respect to both.
        """

    @abc.abstractmethod
    def combine(self, terms: Mapping[str, Tensor], start: Mapping[str, Tensor]) -> Tensor:
        """The rewards (B,) of moments.

        Args:
            terms: Those of the moments.
            start: Those of the beginning of each world's episode.
        """


class MatchedTransport:
    """Exact Wasserstein-1 distance between a fixed random subset of the clay's particles and one of the goal's, as large.

    The subsets' particles are matched one to one by linear assignment, so that the value depends on nothing but the positions:
    a state that comes again has the same distance again. Where the goal's particles are the body's, one to one, both subsets
    are of the same particles, and the distance is zero at the goal; elsewhere it has the floor of a sample of that size.

    Args:
        task: Its goal counts.
        goal: Goal particles (M, 3), length units.
        points: Size of the subsets.

    Raises:
        InputError: `points` is below 1.
    """

    def __init__(self, task: Task, goal: Tensor, *, points: int = POINTS) -> None:
        if points < 1:
            raise InputError("points", came=str(points), expected="at least 1")
        count = task.scene.particle_count
        size = min(points, count, len(goal))
        self._index = _subset(count, size, seed=0)
        self._goal = goal[_subset(len(goal), size, seed=0 if len(goal) == count else 1)]

    def distance(self, positions: Tensor) -> Tensor:
        """Distances (B,) of positions (B, N, 3), length units, differentiable."""
        from scipy.optimize import linear_sum_assignment

        clouds, goal = positions[:, self._index.to(positions.device)], self._goal.to(positions)
        with torch.no_grad():
            costs = torch.cdist(clouds.detach().double(), goal.double()).cpu().numpy()
            matched = torch.as_tensor([linear_sum_assignment(cost)[1].tolist() for cost in costs]).to(goal.device)
        difference = clouds - goal[matched]
        # A particle at its goal has no direction to go; autograd of a norm would be nan there.
        return (difference.square().sum(dim=-1) + 1e-16).sqrt().mean(dim=1)


class RewardTransport(Reward):
    """The paper's reward, -(W1 + distance of the tools to the clay), after every step.

    Args:
        task: Tools and goal.
        goal: Goal particles (M, 3), length units.
        points: Particles that W1 is computed on, see `MatchedTransport`.

    References:
        Li et al., "Contact Points Discovery for Soft-Body Manipulations with Differentiable Physics", ICLR 2022.
    """

    def __init__(self, task: Task, goal: Tensor, *, points: int = POINTS) -> None:
        self.scene, self.transport = task.scene, MatchedTransport(task, goal, points=points)

    def terms(self, positions: Tensor, poses: Tensor) -> dict[str, Tensor]:
        """``"w1"`` and ``"tool_distance"``, length units."""
        return {"w1": self.transport.distance(positions), "tool_distance": tool_distance(self.scene, positions, poses)}

    def combine(self, terms: Mapping[str, Tensor], start: Mapping[str, Tensor]) -> Tensor:
        """Minus the sum; the start does not count."""
        return -(terms["w1"] + terms["tool_distance"])


class RewardPlasticineLab(Reward):
    """PlasticineLab's reward: its loss at the episode's start less its loss now, so that it is 0 at the start.

    The loss is 10 density + 10 distance + contact, see `cpdeform.planning.objectives.plasticinelab`.

    Args:
        task: Grid, tools and goal.
        goal: Goal particles (M, 3), length units.
        points: Not used: node masses are those of all particles.

    References:
        Huang et al., "PlasticineLab: A Soft-Body Manipulation Benchmark with Differentiable Physics", ICLR 2021.
    """

    def __init__(self, task: Task, goal: Tensor, *, points: int = POINTS) -> None:
        self._loss = ObjectivePlasticineLab(task.scene, goal_mass_grid(task, goal), contact="hard")

    def terms(self, positions: Tensor, poses: Tensor) -> dict[str, Tensor]:
        """``"density"``, ``"sdf"`` and ``"contact"``, without their weights."""
        return self._loss.terms(positions, poses)

    def combine(self, terms: Mapping[str, Tensor], start: Mapping[str, Tensor]) -> Tensor:
        """How much the weighted sum of the terms fell since the start."""
        return self._weighted(start) - self._weighted(terms)

    def _weighted(self, terms: Mapping[str, Tensor]) -> Tensor:
        loss = self._loss
        return loss.density_weight * terms["density"] + loss.sdf_weight * terms["sdf"] + loss.contact_weight * terms["contact"]


def tool_distance(scene: Scene, positions: Tensor, poses: Tensor) -> Tensor:
    """Distance (B,) between the clay and each movable tool, summed over the tools, length units; a tool in the clay has none.

    Args:
        scene: Whose tools they are.
        positions: Particle positions (B, N, 3).
        poses: Tool poses (B, M, 8).
    """
    total = positions.new_zeros(len(positions))
    for index, tool in enumerate(scene.tools):
        if tool.movable:
            # Only the nearest particle has to be part of the autograd graph.
            with torch.no_grad():
                nearest = signed_distance(tool, poses[:, index], positions).argmin(dim=-1)
            point = positions.gather(1, nearest[:, None, None].expand(-1, 1, 3))
            total = total + signed_distance(tool, poses[:, index], point).squeeze(-1).clamp(min=0.0)
    return total


def make_reward(name: str, task: Task, goal: Tensor, *, points: int = POINTS) -> Reward:
    """The reward of a name.

    Args:
        name: ``"transport"``, ``"plasticinelab"``, or ``"auto"``: what the paper takes for the task.
        task: The task.
        goal: Goal particles (M, 3), length units.
        points: Particles that W1 is computed on.

    Raises:
        InputError: There is no such reward.
    """
    if name == "auto":
        name = "plasticinelab" if task.name in PLASTICINELAB_TASKS else "transport"
    kinds: dict[str, type[RewardTransport] | type[RewardPlasticineLab]] = {
        "transport": RewardTransport,
        "plasticinelab": RewardPlasticineLab,
    }
    if name not in kinds:
        raise InputError("reward", came=f'"{name}"', expected="auto, transport or plasticinelab, or a Reward")
    return kinds[name](task, goal, points=points)


def _subset(count: int, size: int, *, seed: int) -> Tensor:
    """Sorted random indices (size,) out of `count`."""
    return torch.randperm(count, generator=torch.Generator().manual_seed(seed))[:size].sort().values
