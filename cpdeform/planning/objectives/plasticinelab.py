"""PlasticineLab's objective: density, distance and contact terms summed over all steps."""

from __future__ import annotations

import functools
from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from cpdeform.core.errors import InputError
from cpdeform.core.objective import ObjectiveAutograd
from cpdeform.core.scene import Scene
from cpdeform.planning.objectives.contact import ContactKind, check_contact_kind, contact_loss
from cpdeform.planning.objectives.mass import mass_grid

__all__ = ["ObjectivePlasticineLab", "goal_distance", "mass_grid"]

GOAL_THRESHOLD = 1e-4
"""Node mass above which a node belongs to the goal."""

DISTANCE_EPSILON = 1e-8
"""Added to squared distances to the goal, length units squared (PlasticineLab's quirk)."""

CHUNK_VALUES = 2**22
"""Node masses and stencil weights held at once; frames are evaluated in pieces of this size."""


def goal_distance(goal_grid: Tensor) -> Tensor:
    """Distance of each node to the nearest node of the goal, i.e. the nearest with a mass above 1e-4.

    Args:
        goal_grid: Node masses (G, G, G) of the goal.

    Returns:
        Distances (G, G, G), length units, in the type and on the device of `goal_grid`; zero on the goal.

    Raises:
        InputError: No node belongs to the goal.
    """
    from scipy.ndimage import distance_transform_edt

    occupied = (goal_grid > GOAL_THRESHOLD).cpu().numpy()
    if not occupied.any():
        raise InputError(
            "goal_grid",
            came=f"a largest node mass of {float(goal_grid.max()):.3g}",
            expected=f"at least one node with a mass above {GOAL_THRESHOLD:g}",
            remedy="Sample the goal with more particles, or check that its node masses count the particles' masses.",
        )
    distance = torch.as_tensor(distance_transform_edt(~occupied)).to(goal_grid.device) / goal_grid.shape[0]
    distance = torch.where(distance > 0.0, (distance**2 + DISTANCE_EPSILON).sqrt(), 0.0)
    return distance.to(goal_grid.dtype)


class ObjectivePlasticineLab(ObjectiveAutograd):
    """Sum over the steps t = 1..T of weighted density, distance and contact terms.

    With node masses m of the particles and m* of the goal: density = sum |m - m*|, distance = sum m dist*, where dist* is
    a node's distance to the goal's nearest node; contact: see `contact_loss`. Terms are raw, then weighted.

    Args:
        scene: Grid, particle mass and tools.
        goal_grid: Node masses (G, G, G) of the goal, as `mass_grid` makes them.
        density_weight: Weight of the density term, 1/mass.
        sdf_weight: Weight of the distance term, 1/(mass length).
        contact_weight: Weight of the contact term, 1/length^2.
        contact: ``"plasticinelab"`` (nearest particle, with the gradient PlasticineLab computes; its default), ``"hard"``
            (nearest particle, with its true gradient) or ``"soft"`` (weighted mean); see `contact_loss`.

    Raises:
        InputError: The grid does not fit the scene or holds no goal, a weight is negative, or `contact` is unknown.

    References:
        Huang et al., "PlasticineLab: A Soft-Body Manipulation Benchmark with Differentiable Physics", ICLR 2021.
    """

    def __init__(
        self,
        scene: Scene,
        goal_grid: Tensor | NDArray[Any],
        *,
        density_weight: float = 10.0,
        sdf_weight: float = 10.0,
        contact_weight: float = 1.0,
        contact: ContactKind = "plasticinelab",
    ) -> None:
        check_contact_kind(contact)
        weights = {"density_weight": density_weight, "sdf_weight": sdf_weight, "contact_weight": contact_weight}
        for name, weight in weights.items():
            if not 0.0 <= weight < float("inf"):
                raise InputError(name, came=str(weight), expected="a finite number of at least 0")
        grid = torch.as_tensor(goal_grid).detach()
        if tuple(grid.shape) != (scene.grid_size,) * 3:
            raise InputError("goal_grid", came=f"shape {tuple(grid.shape)}", expected=f"shape {(scene.grid_size,) * 3}")
        if not bool(torch.isfinite(grid).all()) or bool((grid < -GOAL_THRESHOLD).any()):
            raise InputError("goal_grid", came="negative or non-finite masses", expected="finite masses of at least 0")
        self.scene, self.contact, self.contact_weight = scene, contact, contact_weight
        self.density_weight, self.sdf_weight = density_weight, sdf_weight
        self.goal_grid = grid
        self.goal_distance = goal_distance(grid)

    def terms(self, positions: Tensor, tool_poses: Tensor) -> dict[str, Tensor]:
        """Unweighted terms of single moments.

        Args:
            positions: Particle positions (..., N, 3), length units.
            tool_poses: Tool poses (..., M, 8).

        Returns:
            ``"density"`` (mass), ``"sdf"`` (mass times length) and ``"contact"`` (length squared), each (...).
        """
        mass, axes = mass_grid(positions, self.scene), (-3, -2, -1)
        density = (mass - self.goal_grid.to(mass)).abs().sum(dim=axes)
        distance = (mass * self.goal_distance.to(mass)).sum(dim=axes)
        return {
            "density": density,
            "sdf": distance,
            "contact": contact_loss(self.scene, positions, tool_poses, kind=self.contact),
        }

    def _weighted(self, positions: Tensor, tool_poses: Tensor) -> Tensor:
        terms = self.terms(positions, tool_poses)
        return self.density_weight * terms["density"] + self.sdf_weight * terms["sdf"] + self.contact_weight * terms["contact"]

    def loss(self, positions: Tensor, tool_poses: Tensor) -> Tensor:
        """Loss (B,) of positions (B, T+1, N, 3), length units, and tool poses (B, T+1, M, 8); the start does not count."""
        moments = positions[:, 1:].flatten(0, 1)
        poses = tool_poses[:, 1:].flatten(0, 1)
        step = max(1, CHUNK_VALUES // (self.scene.grid_size**3 + 27 * positions.shape[2]))
        # Checkpointing frees each piece's grids until its gradient is due; the masses are cheap beside the simulation.
        recompute = functools.partial(checkpoint, self._weighted, use_reentrant=False, preserve_rng_state=False)
        starts = range(0, moments.shape[0], step)
        parts = [recompute(moments[low : low + step], poses[low : low + step]) for low in starts]
        return torch.cat(parts).reshape(positions.shape[0], -1).sum(dim=1)
