"""How much of the final mass lies at the wrong nodes."""

from __future__ import annotations

from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor

from cpdeform.core.errors import InputError
from cpdeform.core.objective import ObjectiveAutograd
from cpdeform.core.scene import Scene
from cpdeform.planning.objectives.mass import mass_grid


class ObjectiveDensity(ObjectiveAutograd):
    """Share of the final mass that lies at other grid nodes than the goal's, sum |m - m*| / (2 sum m*).

    The density term of PlasticineLab's objective, of the last step only and without unit: 0 where all nodes have the goal's
    mass, 1 where the shapes share no node. It looks no farther than a node's neighbours, so it has no gradient towards a goal
    far away. Near the goal it sees what the transport cost does not: below the sampling floor that cost fits the plan to the
    goal's sample of particles.

    Args:
        scene: Grid and particle mass.
        goal_grid: Node masses (G, G, G) of the goal, as `mass_grid` makes them.

    Raises:
        InputError: The grid does not fit the scene, or holds no mass.

    References:
        Huang et al., "PlasticineLab: A Soft-Body Manipulation Benchmark with Differentiable Physics", ICLR 2021.
    """

    def __init__(self, scene: Scene, goal_grid: Tensor | NDArray[Any]) -> None:
        self.scene, self.goal_grid = scene, check_goal_grid(goal_grid, scene)

    def loss(self, positions: Tensor, tool_poses: Tensor) -> Tensor:
        """Misplaced share (B,) of the mass at the last step of positions (B, T+1, N, 3); the tools do not count."""
        mass = mass_grid(positions[:, -1].double(), self.scene)
        goal = self.goal_grid.to(mass)
        misplaced: Tensor = (mass - goal).abs().sum(dim=(-3, -2, -1)) / (2.0 * goal.sum())
        return misplaced


def check_goal_grid(goal_grid: Tensor | NDArray[Any], scene: Scene) -> Tensor:
    """Node masses (G, G, G) of a goal in double precision; `InputError` where they do not fit the scene or hold no mass."""
    grid = torch.as_tensor(goal_grid).detach().double()
    if tuple(grid.shape) != (scene.grid_size,) * 3:
        raise InputError("goal_grid", came=f"shape {tuple(grid.shape)}", expected=f"shape {(scene.grid_size,) * 3}")
    if not bool(torch.isfinite(grid).all()) or not float(grid.sum()) > 0.0:
        raise InputError("goal_grid", came="no mass or non-finite masses", expected="finite masses with a positive sum")
    return grid
