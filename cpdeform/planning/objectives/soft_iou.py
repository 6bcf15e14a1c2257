"""How far the final shape is from PlasticineLab's metric of a perfect one."""

from __future__ import annotations

from typing import Any

from numpy.typing import NDArray
from torch import Tensor

from cpdeform.core.objective import ObjectiveAutograd
from cpdeform.core.scene import Scene
from cpdeform.planning.objectives.density import check_goal_grid
from cpdeform.planning.objectives.mass import mass_grid
from cpdeform.planning.objectives.metrics import soft_iou


class ObjectiveSoftIoU(ObjectiveAutograd):
    """1 - IoU(m, m*) / IoU(m*, m*), with the soft IoU of PlasticineLab's metric, of the last step only and without unit.

    It is 0 for the goal's own node masses, 1 where the shapes share no node, and below 0 where the clay is spread more evenly
    than the goal: soft IoU divides each grid by its largest node, so that one crowded node costs as much as a wrong shape. It
    looks no farther than a node's neighbours, so it has no gradient towards a goal far away.

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
        """Missing part (B,) of the soft IoU at the last step of positions (B, T+1, N, 3); the tools do not count."""
        mass = mass_grid(positions[:, -1].double(), self.scene)
        goal = self.goal_grid.to(mass)
        missing: Tensor = 1.0 - soft_iou(mass, goal) / soft_iou(goal, goal)
        return missing
