"""All tasks: they load, their goals are shapes of the same clay above the floor, and the files are what the makers make."""

from __future__ import annotations

import functools
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from cpdeform.core.errors import UnknownNameError
from cpdeform.core.goal import load_correspondence
from cpdeform.core.plugins import load_registry
from cpdeform.core.sampling import body_index, sample_particles
from cpdeform.core.state import initial_state
from cpdeform.core.task import Task, list_variants, load_task, task_path
from cpdeform.planning.algorithm import check_tools_outside
from cpdeform.planning.objectives.metrics import soft_iou
from cpdeform.planning.objectives.plasticinelab import mass_grid
from cpdeform.tasks import sculptures
from cpdeform.tasks.make_goals import MAKERS, SHARE, agreement, chosen, make
from cpdeform.tasks.plugin import TASKS
from cpdeform.tasks.solids import Solid, body_volume

DOCUMENT = Path(__file__).resolve().parents[2] / "docs" / "tasks.md"
REGISTRY = load_registry()
BASES = [name for name, _, _ in TASKS]
MULTI_STAGE = ("airplane", "chair", "bottle", "star", "move++", "rope++", "writer++", "pinch")
SOLIDS = {name: getattr(sculptures, name) for name in ("airplane", "chair", "bottle", "star")}
CHEAP = ("bottle", "move++", "rope++", "pinch", "writer-v3")
"""Goals that are made in about two seconds or less, of each kind one."""


def names() -> list[str]:
    found = []
    for base in BASES:
        found += [f"{base}-{variant}" for variant in list_variants(task_path(base, registry=REGISTRY))] or [base]
    return found


@functools.cache
def loaded(name: str) -> tuple[Task, NDArray[np.float64], NDArray[np.float64]]:
    """A task, its start and its goal."""
    task = load_task(name, registry=REGISTRY)
    return task, sample_particles(task.scene), task.load_goal()


def spread(positions: NDArray[np.float64]) -> float:
    """Standard deviation of the distances to the nearest neighbours by their mean."""
    distance = cKDTree(positions).query(positions, k=2)[0][:, 1]
    return float(distance.std() / distance.mean())


def test_seventeen_tasks_and_a_maker_for_each_goal() -> None:
    assert len(BASES) == 17
    assert sorted(MAKERS) == sorted(names())
    files = [loaded(name)[0].goal for name in names()]
    assert sorted(path.name for path in files[0].parent.glob("*.npz")) == sorted(path.name for path in files)
    for name in names():
        assert load_correspondence(loaded(name)[0].goal) == MAKERS[name][1]


@pytest.mark.parametrize("base", BASES)
def test_multi_stage_tasks_are_judged_by_transport_and_the_others_have_five_variants(base: str) -> None:
    variants = list_variants(task_path(base, registry=REGISTRY))
    task = load_task(base, registry=REGISTRY)
    if base in MULTI_STAGE:
        assert not variants
        assert task.metric == "wasserstein"
        assert task.stage_count > 1
    else:
        assert variants == ["v1", "v2", "v3", "v4", "v5"]
        assert task.name == f"{base}-v1"
        assert task.metric == "incremental_iou"
        assert task.stage_count == 1
        assert len({loaded(f"{base}-{variant}")[2].tobytes() for variant in variants}) == 5


@pytest.mark.parametrize("name", names())
def test_goal_is_of_the_same_clay_and_in_the_domain(name: str) -> None:
    task, start, goal = loaded(name)
    assert goal.shape == start.shape
    lower, upper = (np.asarray(corner) for corner in task.scene.domain)
    assert (goal >= lower - 1e-4).all()
    assert (goal <= upper + 1e-4).all()
    assert task.goal.stat().st_size < (130_000 if name == "chair" else 80_000)


@pytest.mark.parametrize("name", names())
def test_no_particle_was_flung_away(name: str) -> None:
    task, start, goal = loaded(name)
    alone = cKDTree(goal).query(goal, k=2)[0][:, 1].max()
    assert alone < 2.0 * task.scene.node_distance
    assert np.linalg.norm(goal - start.mean(axis=0), axis=1).max() < 0.55


@pytest.mark.parametrize("name", names())
def test_goal_differs_from_the_start(name: str) -> None:
    """Otherwise the normalised incremental IoU would have no way to go."""
    task, start, goal = loaded(name)
    grids = [mass_grid(torch.as_tensor(positions), task.scene) for positions in (start, goal)]
    assert float(soft_iou(grids[1], grids[1]) - soft_iou(grids[0], grids[1])) > 2e-3
    if load_correspondence(task.goal):
        moved = np.linalg.norm(goal - start, axis=1)
        assert moved.max() > 0.04
        assert (moved > 0.01).sum() > 150


@pytest.mark.parametrize("name", names())
def test_tools_start_outside_the_clay(name: str) -> None:
    task = loaded(name)[0]
    check_tools_outside(task.scene, initial_state(task.scene, dtype=torch.float64))


@pytest.mark.parametrize("base", BASES)
def test_a_short_rollout_stays_finite(base: str) -> None:
    task = load_task(base, registry=REGISTRY)
    backend = REGISTRY.resolve("simulator", "auto", device="cpu")
    simulator = REGISTRY.create("simulator", backend, scene=task.scene, dtype=torch.float32)
    state = simulator.initial_state(batch_size=1)
    end = simulator.rollout(state, torch.full((1, 2, task.scene.action_size), 0.2)).final_state
    assert torch.isfinite(end.position).all()
    assert float((end.position - state.position).abs().max()) < 0.05


@pytest.mark.parametrize("name", SOLIDS)
def test_solid_has_the_volume_of_the_clay(name: str) -> None:
    task = loaded(name)[0]
    volume = sum(body_volume(body) for body in task.scene.bodies)
    solid: Solid = SOLIDS[name]().fitted_to(volume)
    lower, upper = solid.corners
    points = np.random.default_rng(1).uniform(lower, upper, (400_000, 3))
    share = float(solid.contains(points).mean())
    error = np.sqrt((1.0 - share) / share / len(points))
    assert share * np.prod(upper - lower) == pytest.approx(volume, rel=4.0 * error + 5e-4)


@pytest.mark.parametrize("name", SOLIDS)
def test_solid_is_filled_evenly(name: str) -> None:
    task, start, goal = loaded(name)
    solid: Solid = SOLIDS[name]().fitted_to(sum(body_volume(body) for body in task.scene.bodies))
    assert solid.contains(goal).mean() > 0.999
    assert spread(goal) < 0.4 * spread(start)
    # Every part is filled with as many particles as its volume asks for: boxes of equal numbers of random points.
    lower, upper = solid.corners
    points = np.random.default_rng(2).uniform(lower, upper, (300_000, 3))
    points = points[solid.contains(points)]
    middle = np.median(points, axis=0)
    shares = [np.bincount((cloud > middle) @ [1, 2, 4], minlength=8) / len(cloud) for cloud in (points, goal)]
    assert np.abs(shares[0] - shares[1]).max() < 0.01


@pytest.mark.parametrize("name", SOLIDS)
def test_solid_stands_where_the_clay_comes_to_rest(name: str) -> None:
    task, _, goal = loaded(name)
    backend = REGISTRY.resolve("simulator", "auto", device="cpu")
    simulator = REGISTRY.create("simulator", backend, scene=task.scene, dtype=torch.float32)
    actions = torch.zeros(1, 20, task.scene.action_size)
    rested = simulator.rollout(simulator.initial_state(batch_size=1), actions).final_state.position[0, :, 1].numpy()
    assert goal[:, 1].min() == pytest.approx(np.quantile(rested, 1e-3), abs=0.004)


def test_cubes_are_moved_whole_along_the_floor() -> None:
    task, start, goal = loaded("move++")
    for body in range(3):
        shift = (goal - start)[body_index(task.scene) == body]
        assert np.ptp(shift, axis=0).max() < 2e-5
        assert 0.1 < np.linalg.norm(shift[0]) < 0.2
        assert abs(shift[0, 1]) < 2e-5


def test_rope_keeps_its_length_and_its_cross_section() -> None:
    _, start, goal = loaded("rope++")
    ends = [cloud[order] for cloud in (start, goal) for order in [np.argsort(start[:, 0])]]
    chunks = [np.stack([part.mean(axis=0) for part in np.array_split(cloud, 60)]) for cloud in ends]
    length = [np.linalg.norm(np.diff(middle, axis=0), axis=1).sum() for middle in chunks]
    assert length[1] == pytest.approx(length[0], rel=0.02)
    assert np.abs(goal[:, 1] - start[:, 1]).max() < 2e-5
    assert np.linalg.norm(chunks[1][-1] - chunks[1][0]) < 0.97 * length[1]


@pytest.mark.parametrize("name", CHEAP)
def test_goal_is_made_again(name: str) -> None:
    backend = REGISTRY.resolve("simulator", "auto", device="cpu")
    task = loaded(name)[0]
    assert agreement(task, make(task, backend=backend, registry=REGISTRY)) >= SHARE


def test_makers_are_chosen_by_name() -> None:
    assert chosen([]) == list(MAKERS)
    assert chosen(["move"]) == [f"move-v{number}" for number in range(1, 6)]
    assert chosen(["star", "rope-v2"]) == ["star", "rope-v2"]
    with pytest.raises(UnknownNameError):
        chosen(["vase"])


@pytest.mark.parametrize("base", BASES)
def test_document_says_what_the_file_says(base: str) -> None:
    task = load_task(base, registry=REGISTRY)
    row = re.search(rf"^\| `{re.escape(base)}` \|(.*)\|$", DOCUMENT.read_text(encoding="utf-8"), flags=re.MULTILINE)
    assert row, f"docs/tasks.md has no row for {base}"
    cells = [cell.strip() for cell in row.group(1).split("|")]
    rest = f" + {task.rest_steps}" if task.rest_steps else ""
    metric = {"wasserstein": "W1", "incremental_iou": "IoU"}[task.metric]
    assert cells[3:6] == [f"{task.step_count}{rest}", str(task.stage_count), metric]
