from __future__ import annotations

import dataclasses
import importlib.util
import math

import numpy as np
import pytest
import torch

from cpdeform.core.errors import InputError
from cpdeform.core.goal import load_correspondence, load_goal, load_goal_grid, write_goal
from cpdeform.core.meshes.filling import fill_evenly
from cpdeform.core.plugins import load_registry
from cpdeform.core.sampling import sample_particles
from cpdeform.core.task import load_task
from cpdeform.planning.metrics import evaluate_metric, metric_solver, wasserstein
from cpdeform.planning.objectives.mass import mass_grid
from cpdeform.planning.objectives.metrics import incremental_iou
from cpdeform.run.evaluation import evaluate, evaluate_record, exact_wasserstein, paper_wasserstein, sampling_floor
from cpdeform.run.record import RunRecorder, load_record
from cpdeform.tasks.solids import Block, Solid

needs_geomloss = pytest.mark.skipif(importlib.util.find_spec("geomloss") is None, reason="GeomLoss is not installed")
needs_pot = pytest.mark.skipif(importlib.util.find_spec("ot") is None, reason="POT is not installed")


@pytest.fixture
def task(toy_task_file):
    """A ball, to be shifted by 0.1."""
    return load_task(toy_task_file)


@pytest.fixture
def clouds(task):
    """Start, half of the way, and goal."""
    start = torch.as_tensor(sample_particles(task.scene))
    return start, start + torch.tensor([0.05, 0.0, 0.0]), torch.as_tensor(task.load_goal())


def random_clouds(*, count=700, other=500):
    generator = torch.Generator().manual_seed(0)
    first, second = (torch.rand(size, 3, dtype=torch.float64, generator=generator) * 0.3 for size in (count, other))
    second[:100] = first[:100]  # pairs at distance zero, where GeomLoss's floor counts
    return first, second + torch.tensor([0.1, 0.0, 0.02])


@needs_geomloss
@pytest.mark.parametrize("blur", [1e-2, 1e-3, 1e-5])
@pytest.mark.parametrize("debias", [True, False])
def test_the_streamed_schedule_is_geomloss(monkeypatch, blur, debias):
    from geomloss import SamplesLoss

    import cpdeform.ot.geomloss

    first, second = random_clouds()
    points = first.clone().requires_grad_(True)
    expected = SamplesLoss("sinkhorn", p=1, blur=blur, scaling=0.5, debias=debias, backend="tensorized")(points, second)
    (gradient,) = torch.autograd.grad(expected, points)
    monkeypatch.setattr(cpdeform.ot.geomloss, "_PAPER_DENSE", 0)
    monkeypatch.setattr("cpdeform.ot.schedule._CHUNK_CPU", 2**14)
    result = cpdeform.ot.geomloss.OTSolverGeomLoss(blur=blur, settings="paper", debias=debias).solve(first, second)
    assert float(result.value) == pytest.approx(expected.item(), rel=1e-10)
    torch.testing.assert_close(result.source_gradient, gradient, rtol=1e-6, atol=1e-6 * float(gradient.abs().max()))
    if debias:
        assert paper_wasserstein(first, second, blur=blur) == pytest.approx(expected.item(), rel=1e-10)


@needs_geomloss
@needs_pot
def test_all_distances(task, clouds):
    start, middle, goal = clouds
    result = evaluate(task, start=start, final=middle, goal=goal, paper=True, exact=True)
    # A cloud and its copy, shifted, are as far apart as the shift.
    assert (result.exact_start, result.exact_final) == pytest.approx((0.1, 0.05), rel=1e-6)
    assert result.exact_method == "ot.emd2"
    assert (result.wasserstein_start, result.wasserstein_final) == pytest.approx((0.1, 0.05), rel=0.02)
    assert (result.wasserstein_blur, result.converged) == (1e-3, True)
    assert result.paper_blur == 1e-5  # the task is one of two stages
    assert 0.5 < result.paper_final / result.exact_final < 1.0
    assert 0.5 < result.paper_floor / result.sampling_floor < 1.0
    assert evaluate(task, start=start, final=middle, goal=goal, paper=True, paper_blur=1e-3).paper_blur == 1e-3
    plain = evaluate(task, start=start, final=middle, goal=goal)
    assert (plain.paper_start, plain.paper_blur, plain.exact_final, plain.exact_method) == (None, None, None, None)
    assert set(plain.seconds) == {"iou", "wasserstein", "floor"}
    assert (plain.particle_count, plain.goal_count) == (60, 60)


def test_exact_without_network_simplex(monkeypatch):
    first, second = random_clouds(count=300, other=300)
    exact, _ = exact_wasserstein(first, second)
    monkeypatch.setattr("cpdeform.run.evaluation.MAX_EMD_PAIRS", 0)
    value, method = exact_wasserstein(first, second)
    assert value == pytest.approx(exact, rel=5e-3)
    assert "blur 0.0001" in method


@pytest.mark.parametrize("kind", ["random", "even"])
def test_sampling_floor_is_the_distance_of_a_random_sample(kind):
    generator, count = torch.Generator().manual_seed(1), 1500
    widths = torch.tensor([0.3, 0.1, 0.3], dtype=torch.float64)
    sample, goal = (torch.rand(count, 3, generator=generator, dtype=torch.float64) * widths for _ in range(2))
    if kind == "even":
        block = Block(lower=(0.0, 0.0, 0.0), upper=(0.3, 0.1, 0.3))
        goal = torch.as_tensor(fill_evenly(Solid(parts=(block,), origin=(0.0, 0.0, 0.0)), count))
    solver = metric_solver()

    def distance(first, second):
        return float(wasserstein(first, second, solver=solver).value)

    assert sampling_floor(goal, distance=distance) == pytest.approx(distance(sample, goal), rel=0.12)
    assert math.isnan(sampling_floor(goal[:1], distance=distance))


def test_goals_that_share_the_particles_have_no_floor(task, clouds, tmp_path):
    start, middle, goal = clouds
    assert evaluate(task, start=start, final=middle, goal=goal).sampling_floor > 0.0
    path = tmp_path / "goal.npz"
    write_goal(path, goal.numpy(), corresponds=True)
    changed = task.model_copy(update={"goal": path})
    result = evaluate(changed, start=start, final=middle, goal=goal)
    assert (result.corresponds, result.sampling_floor) == (True, 0.0)
    write_goal(path, goal.numpy()[:50], corresponds=True)
    assert not changed.goal_corresponds()


def test_iou_uses_the_grid_of_the_goal(task, clouds, tmp_path):
    start, middle, goal = clouds
    plain = evaluate(task, start=start, final=middle, goal=goal)
    assert plain.grid == "particles"
    grid = mass_grid(goal + torch.tensor([0.02, 0.0, 0.0]), task.scene)
    path = tmp_path / "goal.npz"
    write_goal(path, goal.numpy(), grid=grid.numpy())
    changed = task.model_copy(update={"goal": path, "metric": "incremental_iou"})
    result = evaluate(changed, start=start, final=middle, goal=goal)
    expected = incremental_iou(mass_grid(middle, task.scene), start=mass_grid(start, task.scene), goal=grid)
    assert result.grid == "file"
    assert result.incremental_iou == pytest.approx(float(expected), rel=1e-5)
    assert result.incremental_iou != pytest.approx(plain.incremental_iou, rel=1e-2)
    metric = evaluate_metric(changed, start=start.float(), final=middle.float(), goal=goal.float())
    assert (metric.initial, metric.final) == pytest.approx((0.0, result.incremental_iou), rel=1e-4)


def test_metric_is_the_converged_distance(task, clouds):
    start, middle, goal = clouds
    result = evaluate(task, start=start, final=middle, goal=goal)
    metric = evaluate_metric(task, start=start, final=middle, goal=goal)
    assert (metric.initial, metric.final) == (result.wasserstein_start, result.wasserstein_final)
    still = evaluate_metric(task, start=start, final=start, goal=goal)
    assert still.initial == still.final == metric.initial


def test_metric_without_a_solver_is_unknown(task, clouds):
    start, middle, goal = clouds
    with pytest.warns(UserWarning, match="metric is not known: .*nothing that is installed"):
        metric = evaluate_metric(task, start=start, final=middle, goal=goal, registry=load_registry([]))
    assert math.isnan(metric.final)


def test_goal_files(task, tmp_path):
    generator = np.random.default_rng(0)
    position, grid = generator.uniform(0.2, 0.8, (50, 3)), np.zeros((64, 64, 64))
    grid[20:30, 5:9, 40] = generator.uniform(1e-5, 1e-3, (10, 4))
    first, second = tmp_path / "first.npz", tmp_path / "second.npz"
    for path in (first, second):
        write_goal(path, position, grid=grid)
    assert first.read_bytes() == second.read_bytes()
    np.testing.assert_allclose(load_goal(first, scene=task.scene), position, atol=2**-17)
    np.testing.assert_allclose(load_goal_grid(first, scene=task.scene), grid, rtol=1e-6)
    assert not load_correspondence(first)
    write_goal(second, np.full((3, 3), 2**15, dtype=np.uint16))
    np.testing.assert_array_equal(load_goal(second, scene=task.scene), np.full((3, 3), 0.5))
    assert load_goal_grid(second, scene=task.scene) is None


def test_records(task, clouds, tmp_path):
    from cpdeform_toy.parts import OTSolverToy, PlacerToy
    from cpdeform_toy.simulator import SimulatorToy

    from cpdeform.planning.optimizer import TrajectoryOptimizer
    from cpdeform.run.deform import deform

    path = tmp_path / "goal.npz"
    grid = mass_grid(clouds[2], task.scene).numpy()
    write_goal(path, clouds[2].numpy(), grid=grid, corresponds=True)
    task = task.model_copy(update={"goal": path})
    recorder = RunRecorder(tmp_path / "run")
    result = deform(
        task,
        simulator=SimulatorToy(task.scene, batch_size=4, device="cpu"),
        ot_solver=OTSolverToy(),
        placer=PlacerToy(),
        optimizer=TrajectoryOptimizer(iterations=3),
        observers=[recorder],
    )
    path.unlink()
    record = load_record(tmp_path / "run")
    found = evaluate_record(record)
    assert found.grid == "file"
    assert found.corresponds
    assert (record.run["metric_initial"], record.run["metric_value"]) == (result.metric_initial, result.metric_value)
    assert (found.wasserstein_start, found.wasserstein_final) == pytest.approx(
        (result.metric_initial, result.metric_value), rel=1e-4
    )
    with pytest.raises(InputError, match="no complete stage"):
        evaluate_record(dataclasses.replace(record, stages=()))
