"""How much of a shape is there, as the eye sees it: volume and silhouette IoU, loose clay, and the distance between surfaces.

The Wasserstein distance weighs how far clay has to go, and hardly tells a crisp figure from a blurred one. These figures look at
which cells of the scene's grid are full instead. A cell is the neighbourhood of a grid node, and it is full where it holds more
than half of the usual mass: the median over the goal's cells with more than a fifth of the mass of its fullest one. Masses are
spread by the quadratic B-spline of the simulator and are shares of the whole, so that clouds of different sizes compare.

An IoU of 1 is never reached, since particles are a random sample of what they stand for: the ceiling is what a random sample of
the goal's own shape has.
"""

from __future__ import annotations

import dataclasses
import functools
import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cpdeform.core.errors import InputError
from cpdeform.core.scene import Scene
from cpdeform.planning.metrics import EVEN_SPREAD
from cpdeform.planning.objectives.mass import mass_grid

Cells = NDArray[np.bool_]
"""Which cells (G, G, G) are full; the axes are x, y (up) and z."""

LOOSE_FRACTION = 0.5
"""A cell is full above this fraction of the usual mass, and particles in cells below it are loose."""

USUAL_ABOVE = 0.2
"""The usual mass is the median over cells above this fraction of the fullest cell's mass: cells at the rim do not count."""

RESAMPLES = 8
"""Samples that the ceiling is the mean of; a single one varies by about 0.005."""

JITTER = 0.5
"""Edge of the cube that a resampled particle is displaced in, over the mean distance between nearest neighbours.

With it the ceilings of `star`, `airplane`, `chair` and `bottle` with 10,000 particles, each at three heights above the grid, are
those of fresh samples of the solids to 0.013, on average to 0.003. With an edge of 1 that of `star` is 0.016 too low: its surface
blurs. Ceilings from a goal that is a random sample itself are right to 0.02, on average to 0.001."""

DISTANCE_PERCENTILE = 95.0
"""Percentile of the distance between surfaces: the largest one is that of a single stray crumb."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class ShapeFigures:
    """How much of a goal's shape is there. IoU, shares: no unit. Nothing is clipped.

    Attributes:
        shape_iou_start: Volume IoU of the start with the goal.
        shape_iou_final: That of the result.
        shape_iou_ceiling: That of a random sample of the goal's own shape, as large as the result.
        normalised_shape_iou: The part of the way from start to ceiling; None where the start is as good as the ceiling.
        silhouette_iou: IoU of the outlines of result and goal, seen along x, y (from above) and z.
        loose_share: Share of the result's particles in cells below half of the usual mass, less that of a sample of the goal.
        distance_95_result_to_goal: 95th percentile of the distance from the result's surface to the goal's, in cells; inf where
            no cell is full. Large where clay lies where none should be.
        distance_95_goal_to_result: The same from the goal's surface to the result's. Large where clay is missing.
    """

    shape_iou_start: float
    shape_iou_final: float
    shape_iou_ceiling: float
    normalised_shape_iou: float | None
    silhouette_iou: tuple[float, float, float]
    loose_share: float
    distance_95_result_to_goal: float
    distance_95_goal_to_result: float


class GoalShape:
    """A goal that results are compared with; what depends on the goal alone is computed once.

    Args:
        goal: Goal particles (M, 3), length units, in the domain.
        scene: Its grid is the one that cells belong to.
        sample_size: Particles N of the results, for the ceiling; defaults to M.
        seed: Seed of the samples behind the ceiling.

    Raises:
        InputError: `goal` is empty, of another shape, or not inside the domain; or `sample_size` is not positive.
    """

    def __init__(self, goal: Tensor, scene: Scene, *, sample_size: int | None = None, seed: int = 0) -> None:
        if goal.ndim != 2 or goal.shape[1:] != (3,) or not len(goal):
            raise InputError("goal", came=f"shape {tuple(goal.shape)}", expected="shape (M, 3) with M >= 1")
        if sample_size is not None and sample_size < 1:
            raise InputError("sample_size", came=str(sample_size), expected="at least 1 particle")
        self.scene = scene
        self.position = goal.detach().cpu().double()
        self.sample_size = sample_size or len(goal)
        self.seed = seed
        share = mass_share(self.position, scene)
        self.usual_mass = usual_mass(share)
        self.cells: Cells = share > LOOSE_FRACTION * self.usual_mass

    def occupied(self, positions: Tensor) -> Cells:
        """Which cells (G, G, G) particles (N, 3), length units, fill."""
        return mass_share(positions, self.scene) > LOOSE_FRACTION * self.usual_mass

    def iou(self, positions: Tensor) -> float:
        """Volume IoU of particles (N, 3), length units, with the goal."""
        return intersection_over_union(self.occupied(positions), self.cells)

    def raw_loose_share(self, positions: Tensor) -> float:
        """Share of particles (N, 3), length units, in cells that are not full, the rim of a crisp shape among them."""
        cells = nearest_cells(positions, self.scene)
        return 1.0 - float(self.occupied(positions)[tuple(cells.T)].mean())

    @functools.cached_property
    def _ceilings(self) -> tuple[float, float]:
        return _ceilings(self)

    @property
    def iou_ceiling(self) -> float:
        """Volume IoU that a random sample of the goal's shape has with it; nan for a goal of too few particles to tell."""
        return self._ceilings[0]

    @property
    def loose_floor(self) -> float:
        """Raw loose share of a random sample of the goal's shape."""
        return self._ceilings[1]

    def figures(self, *, start: Tensor, final: Tensor) -> ShapeFigures:
        """All figures of a result.

        Args:
            start: Particles (N, 3) before, length units.
            final: Particles (N, 3) of the result.

        Raises:
            InputError: Particles are outside the domain, or not of shape (N, 3).
        """
        before, after, ceiling = self.iou(start), self.occupied(final), self.iou_ceiling
        shape_iou = intersection_over_union(after, self.cells)
        return ShapeFigures(
            shape_iou_start=before,
            shape_iou_final=shape_iou,
            shape_iou_ceiling=ceiling,
            normalised_shape_iou=(shape_iou - before) / (ceiling - before) if ceiling > before else None,
            silhouette_iou=silhouette_iou(after, self.cells),
            loose_share=self.raw_loose_share(final) - self.loose_floor,
            distance_95_result_to_goal=surface_distance(after, self.cells),
            distance_95_goal_to_result=surface_distance(self.cells, after),
        )


def mass_share(positions: Tensor, scene: Scene) -> NDArray[np.float64]:
    """Share (G, G, G) of the mass of particles (N, 3), length units, at each grid node: spread by B-splines, sum 1."""
    cloud = positions.detach().cpu().double()
    masses: NDArray[np.float64] = mass_grid(cloud, scene).numpy() / (scene.particle_volume * len(cloud))
    return masses


def usual_mass(share: NDArray[np.float64]) -> float:
    """Mass of a usual cell: the median over the cells above a fifth of the fullest one's, in the unit of `share` (G, G, G)."""
    return float(np.median(share[share > USUAL_ABOVE * share.max()]))


def nearest_cells(positions: Tensor, scene: Scene) -> NDArray[np.int64]:
    """Indices (N, 3) of the cell that each of the particles (N, 3), length units, is in."""
    scaled = positions.detach().cpu().double().numpy() * scene.grid_size
    return np.asarray(np.clip(np.rint(scaled), 0, scene.grid_size - 1), dtype=np.int64)


def intersection_over_union(first: NDArray[np.bool_], second: NDArray[np.bool_]) -> float:
    """Cells that both hold over cells that any holds; 1 where both are empty."""
    union = int((first | second).sum())
    return int((first & second).sum()) / union if union else 1.0


def silhouette_iou(first: Cells, second: Cells) -> tuple[float, float, float]:
    """IoU of the projections of cells (G, G, G) along x, y and z."""
    x, y, z = (intersection_over_union(*(np.asarray(cells.any(axis=axis)) for cells in (first, second))) for axis in range(3))
    return x, y, z


def surface_cells(cells: Cells) -> Cells:
    """Full cells (G, G, G) with an empty one among their six neighbours; what lies outside the grid is empty."""
    padded = np.pad(cells, 1)
    inside = np.logical_and.reduce([np.roll(padded, shift, axis) for axis in range(3) for shift in (-1, 1)])
    return np.asarray(cells & ~inside[1:-1, 1:-1, 1:-1])


def surface_distance(source: Cells, destination: Cells, *, percentile: float = DISTANCE_PERCENTILE) -> float:
    """Percentile of the distance from the surface cells of one shape to the nearest surface cell of another.

    Both directions together are the percentile Hausdorff distance, with 95 the usual one of image segmentation [1]_.

    Args:
        source: Full cells (G, G, G) of the shape that distances are taken from.
        destination: Those of the shape that they are taken to.
        percentile: In [0, 100].

    Returns:
        The distance in cells; inf where a shape has no full cell.

    References:
        .. [1] Huttenlocher, Klanderman, Rucklidge, "Comparing images using the Hausdorff distance", IEEE Transactions on Pattern
           Analysis and Machine Intelligence, 1993.
    """
    if not source.any() or not destination.any():
        return math.inf
    from scipy.ndimage import distance_transform_edt

    distances = distance_transform_edt(~surface_cells(destination))
    return float(np.percentile(distances[surface_cells(source)], percentile))


def _ceilings(goal: GoalShape) -> tuple[float, float]:
    """Volume IoU and raw loose share that a random sample of the goal's shape has, estimated from its particles alone.

    Where these are spread evenly, a sample is drawn from them with replacement, each displaced within a small cube. Where they are
    a random sample themselves, one drawn from them would have their own chance density and be too near: there the misfit 1 - IoU is
    taken between random halves, and between random quarters, which differ by chance four and eight times the variance of one
    particle cloud, and continued to the variance of goal and result as the power of the variance that the two tell.
    """
    generator = torch.Generator().manual_seed(goal.seed)
    count = len(goal.position)
    if count < 8:
        return math.nan, 0.0
    gaps = _neighbour_distances(goal.position)
    if gaps.std() < EVEN_SPREAD * gaps.mean():
        samples = [_resampled(goal, float(gaps.mean()), generator) for _ in range(RESAMPLES)]
        loose = [goal.raw_loose_share(sample) for sample in samples]
        return float(np.mean([goal.iou(sample) for sample in samples])), float(np.mean(loose))
    misfits = {part: _part_misfit(goal, count // part, generator) for part in (2, 4)}
    loose_floor = goal.raw_loose_share(goal.position)
    if misfits[2] <= 0.0 or misfits[4] <= 0.0:
        return 1.0, loose_floor
    exponent = math.log2(misfits[4] / misfits[2])
    variance = (1.0 / count + 1.0 / goal.sample_size) / (4.0 / count)
    return 1.0 - min(1.0, misfits[2] * variance**exponent), loose_floor


def _resampled(goal: GoalShape, gap: float, generator: torch.Generator) -> Tensor:
    """A random sample (N, 3) of an evenly spread goal."""
    drawn = goal.position[torch.randint(len(goal.position), (goal.sample_size,), generator=generator)]
    offset = torch.rand(drawn.shape, generator=generator, dtype=drawn.dtype) - 0.5
    # Only the domain's own faces bound it: a sample must stay on the grid.
    return (drawn + JITTER * gap * offset).clamp(0.0, 1.0)


def _part_misfit(goal: GoalShape, size: int, generator: torch.Generator) -> float:
    """Mean of 1 - IoU between two random parts of the goal, of `size` particles each."""
    misfits = []
    for _ in range(RESAMPLES):
        order = torch.randperm(len(goal.position), generator=generator)
        first, second = goal.position[order[:size]], goal.position[order[size : 2 * size]]
        misfits.append(1.0 - intersection_over_union(goal.occupied(first), goal.occupied(second)))
    return float(np.mean(misfits))


def _neighbour_distances(points: Tensor) -> NDArray[np.float64]:
    """Distance (M,) of each point (M, 3) to the nearest other one."""
    from scipy.spatial import cKDTree

    cloud = points.numpy()
    return np.asarray(cKDTree(cloud).query(cloud, k=2)[0][:, 1])
