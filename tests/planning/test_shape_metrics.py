"""Shape figures against closed forms: lattices of particles at grid nodes, whose B-spline masses are known by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from cpdeform.core.errors import InputError
from cpdeform.core.scene import BodyBox, Scene
from cpdeform.core.task import load_task
from cpdeform.planning.shape_metrics import (
    GoalShape,
    intersection_over_union,
    silhouette_iou,
    surface_cells,
    surface_distance,
    usual_mass,
)
from cpdeform.tasks import sculptures
from cpdeform.tasks.solids import body_volume

SIZE = 64


@pytest.fixture(scope="module")
def scene():
    return Scene(bodies=(BodyBox(position=(0.5, 0.5, 0.5), widths=(0.2, 0.2, 0.2), particle_count=10),))


def lattice(lower, counts):
    """A particle (N, 3) at each node of a block of nodes: the block's nodes are full, those around it are not.

    A row of particles a cell apart gives 1/8 of a cell's mass to the node beyond its end, 7/8 to its end and 1 inside; a corner of
    the block has (7/8)^3 = 0.67 of the usual mass, a node beyond a face at most 1/8.
    """
    axes = [torch.arange(low, low + count, dtype=torch.float64) for low, count in zip(lower, counts, strict=True)]
    return torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1).reshape(-1, 3) / SIZE


def block(lower, counts):
    cells = np.zeros((SIZE,) * 3, dtype=bool)
    cells[tuple(slice(low, low + count) for low, count in zip(lower, counts, strict=True))] = True
    return cells


def test_a_lattice_fills_its_own_nodes(scene):
    counts = (16, 17, 20)  # large enough for most nodes to be inside
    shape = GoalShape(lattice((10, 20, 30), counts), scene)
    assert shape.usual_mass == pytest.approx(1.0 / (16 * 17 * 20))
    np.testing.assert_array_equal(shape.cells, block((10, 20, 30), counts))


def test_usual_mass_is_the_median_above_a_fifth_of_the_largest():
    share = np.zeros((4, 4, 4))
    share[0, 0, :4] = [10.0, 6.0, 4.0, 2.0]  # 2 is not above a fifth of 10
    share[1, 1, :2] = [1.0, 0.5]
    assert usual_mass(share) == 6.0


@pytest.mark.parametrize(("axis", "shift"), [(0, 3), (1, 2), (2, 5)])
def test_boxes_shifted_by_whole_cells(scene, axis, shift):
    counts = (8, 9, 12)
    offset = torch.zeros(3, dtype=torch.float64)
    offset[axis] = shift / SIZE
    goal = lattice((10, 20, 30), counts)
    figures = GoalShape(goal, scene).figures(start=goal + 0.3, final=goal + offset)
    expected = (counts[axis] - shift) / (counts[axis] + shift)
    assert figures.shape_iou_start == 0.0
    assert figures.shape_iou_final == pytest.approx(expected, abs=1e-12)
    # Seen along the shift the outlines are the same.
    assert figures.silhouette_iou == pytest.approx([1.0 if seen == axis else expected for seen in range(3)], abs=1e-12)
    ceiling = figures.shape_iou_ceiling
    assert figures.normalised_shape_iou == pytest.approx(expected / ceiling)


def test_normalised_iou_counts_from_the_start(scene):
    goal = lattice((10, 20, 30), (8, 8, 8))
    shape = GoalShape(goal, scene)
    start, final = (goal + torch.tensor([shift / SIZE, 0.0, 0.0], dtype=torch.float64) for shift in (4, 2))
    figures = shape.figures(start=start, final=final)
    expected = (6 / 10 - 4 / 12) / (shape.iou_ceiling - 4 / 12)
    assert figures.normalised_shape_iou == pytest.approx(expected)
    assert shape.figures(start=goal, final=goal).normalised_shape_iou is None  # the start is above the ceiling


def test_identical_clouds(scene):
    generator = torch.Generator().manual_seed(3)
    goal = 0.3 + 0.2 * torch.rand(4000, 3, generator=generator, dtype=torch.float64)
    shape = GoalShape(goal, scene)
    figures = shape.figures(start=goal, final=goal)
    assert (figures.shape_iou_final, figures.silhouette_iou) == (1.0, (1.0, 1.0, 1.0))
    assert (figures.distance_95_result_to_goal, figures.distance_95_goal_to_result) == (0.0, 0.0)
    assert figures.loose_share == 0.0  # a goal of random particles is its own sample
    assert figures.shape_iou_ceiling < 1.0


def test_order_and_number_of_particles_do_not_count(scene):
    generator = torch.Generator().manual_seed(4)
    goal, final = (0.3 + 0.2 * torch.rand(3000, 3, generator=generator, dtype=torch.float64) for _ in range(2))
    shape = GoalShape(goal, scene)
    order = torch.randperm(3000, generator=generator)
    assert shape.figures(start=goal, final=final) == shape.figures(start=goal, final=final[order])
    # The same cloud twice has twice the particles and the same shares of mass.
    twice = torch.cat([final, final])
    assert shape.iou(twice) == shape.iou(final)
    assert shape.raw_loose_share(twice) == pytest.approx(shape.raw_loose_share(final), abs=1e-12)


def test_loose_particles_are_counted(scene):
    goal = lattice((10, 20, 30), (10, 10, 10))
    shape = GoalShape(goal, scene)
    result = goal.clone()
    # Crumbs, each far from all others: a particle in the middle of a cell gives it 27/64 of its mass, below half of the usual.
    crumbs = [number for number in range(40) if number % 10 not in (0, 9)]
    for place, number in enumerate(crumbs):
        result[number + 400] = torch.tensor([40 + 4 * (place % 4), 8 + 4 * (place // 4), 10], dtype=torch.float64) / SIZE
    assert shape.raw_loose_share(goal) == 0.0
    assert shape.raw_loose_share(result) == pytest.approx(len(crumbs) / 1000)
    figures = shape.figures(start=goal, final=result)
    assert figures.loose_share == pytest.approx(len(crumbs) / 1000 - shape.loose_floor)


def test_surface_cells_are_those_with_an_empty_neighbour():
    cells = block((5, 5, 5), (6, 7, 8))
    assert int(surface_cells(cells).sum()) == 6 * 7 * 8 - 4 * 5 * 6
    # At the grid's own edge there is no neighbour, so these cells are surface, too.
    assert int(surface_cells(np.ones((4, 4, 4), dtype=bool)).sum()) == 64 - 8


def test_surface_distance_in_cells():
    first, second = block((10, 10, 10), (6, 6, 6)), block((10, 10, 13), (6, 6, 6))
    # All cells of the first one's lower face in z lie 3 below the second's; inside the second they are 1 or 2 from its faces.
    assert surface_distance(first, second, percentile=100.0) == 3.0
    assert surface_distance(first, first) == 0.0
    assert math.isinf(surface_distance(first, np.zeros_like(first)))
    # A spike of one cell is far from the goal in one direction only.
    spike = first.copy()
    spike[16:30, 12, 12] = True
    assert surface_distance(spike, first, percentile=100.0) == 14.0
    assert surface_distance(first, spike, percentile=100.0) == 1.0  # the cell under the spike is no surface any more
    # 95 of 100: a few cells do not count.
    assert surface_distance(spike, first) < 14.0


def test_missing_and_superfluous_clay_tell_apart(scene):
    goal = lattice((10, 20, 10), (20, 6, 20))
    half = goal[goal[:, 0] < 20 / SIZE]
    figures = GoalShape(goal, scene).figures(start=goal, final=half)
    assert figures.distance_95_goal_to_result > 8.0
    assert figures.distance_95_result_to_goal < 4.0  # the cut face lies inside the shape, at most half its height from a surface


def test_a_cloud_spread_thin_fills_nothing(scene):
    goal = lattice((10, 20, 30), (8, 8, 8))
    thin = torch.as_tensor(np.random.default_rng(0).uniform(0.05, 0.9, (512, 3)))
    figures = GoalShape(goal, scene).figures(start=goal, final=thin)
    assert figures.shape_iou_final < 0.01
    assert figures.loose_share > 0.9
    empty = np.zeros((8, 8, 8), dtype=bool)
    assert intersection_over_union(empty, empty) == 1.0
    assert silhouette_iou(empty, empty) == (1.0, 1.0, 1.0)


@pytest.fixture(scope="module")
def star():
    """The task's scene and shape, and three fresh random samples of its solid."""
    task = load_task("star")
    solid = sculptures.star().fitted_to(sum(body_volume(body) for body in task.scene.bodies))
    lower, upper = solid.corners
    points = lower + np.random.default_rng(5).random((90000, 3)) * (upper - lower)
    inside = torch.as_tensor(points[solid.contains(points)])
    return task.scene, torch.as_tensor(task.load_goal()), list(inside[:30000].split(10000))


def test_the_ceiling_of_an_even_goal_is_that_of_fresh_samples(star):
    scene, goal, samples = star
    shape = GoalShape(goal, scene)
    measured = np.mean([shape.iou(sample) for sample in samples])
    assert measured == pytest.approx(0.91, abs=0.015)
    assert shape.iou_ceiling == pytest.approx(measured, abs=0.015)
    loose = np.mean([shape.raw_loose_share(sample) for sample in samples])
    assert shape.loose_floor == pytest.approx(loose, abs=0.012)


def test_the_ceiling_of_a_random_goal_is_that_of_fresh_samples(star):
    scene, _, (goal, *samples) = star
    for size in (10000, 4000):
        shape = GoalShape(goal, scene, sample_size=size)
        measured = np.mean([shape.iou(sample[:size]) for sample in samples])
        assert shape.iou_ceiling == pytest.approx(measured, abs=0.03)


def test_the_ceiling_is_repeatable(scene):
    goal = 0.3 + 0.1 * torch.as_tensor(np.random.default_rng(6).random((500, 3)))
    assert GoalShape(goal, scene, seed=7).iou_ceiling == GoalShape(goal, scene, seed=7).iou_ceiling
    assert GoalShape(goal, scene, seed=8).iou_ceiling != GoalShape(goal, scene, seed=7).iou_ceiling
    assert math.isnan(GoalShape(goal[:5], scene).iou_ceiling)


@pytest.mark.parametrize(
    ("goal", "options", "match"),
    [
        (torch.zeros(0, 3), {}, r"goal: got shape \(0, 3\), expected shape \(M, 3\)"),
        (torch.zeros(4, 2), {}, "goal: got shape"),
        (torch.full((4, 3), 1.5), {}, "4 particles outside the domain"),
        (torch.full((4, 3), 0.5), {"sample_size": 0}, "sample_size: got 0"),
    ],
)
def test_unusable_goals_are_refused(scene, goal, options, match):
    with pytest.raises(InputError, match=match):
        GoalShape(goal, scene, **options)
