"""Rollouts and gradients that nobody holds any more leave no memory behind, however many there were."""

from __future__ import annotations

import gc
import os
import weakref
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
import toy_fixtures
from backend_cases import BACKENDS, ORACLE, backend_class, scene, simulator_class, tool

from cpdeform.core.simulator import Simulator, Trajectory, differentiable_rollout
from cpdeform.core.task import load_task
from cpdeform.planning.optimizer import TrajectoryOptimizer
from cpdeform.planning.pruner import PrunerNone
from cpdeform.run.deform import deform

CALLS = 500
MOST_GROWTH = 6e6
"""Bytes that the process may grow by meanwhile. If the trajectories stayed alive, it would be 28 MB and more."""

BODY = {"kind": "box", "position": (0.5, 0.06, 0.5), "widths": (0.12, 0.1, 0.12), "particle_count": 500}
SCENE = scene(tool("Sphere"), bodies=[BODY], grid_size=16, substeps=2)


@pytest.fixture(params=[*BACKENDS, "example"])
def backend(request: pytest.FixtureRequest) -> str:
    return request.param


def make(backend: str) -> Simulator:
    if backend == "example":
        return simulator_class(*ORACLE)(SCENE, dtype=torch.float64)
    return backend_class(backend)(SCENE, threads=1)


def resident_memory() -> int:
    """Bytes of this process that are in memory."""
    with open("/proc/self/statm", encoding="ascii") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def plain(simulator: Simulator, actions: torch.Tensor) -> None:
    trajectory = simulator.rollout(simulator.initial_state(), actions)
    simulator.vjp(trajectory, torch.ones_like(trajectory.positions))


def forward_only(simulator: Simulator, actions: torch.Tensor) -> None:
    differentiable_rollout(simulator, simulator.initial_state(), actions)


def with_backward(simulator: Simulator, actions: torch.Tensor) -> None:
    differentiable_rollout(simulator, simulator.initial_state(), actions).positions.sum().backward()


@pytest.mark.skipif(not os.path.exists("/proc/self/statm"), reason="the memory of a process is read from /proc")
@pytest.mark.parametrize("backend", BACKENDS)  # the plain one is too slow for so many calls
def test_memory_stays_constant_over_many_calls(backend: str) -> None:
    simulator = make(backend)
    actions = torch.zeros(1, 1, 3, dtype=simulator.dtype, requires_grad=True)
    uses = (plain, forward_only, with_backward)
    # first what is allocated once for all, by the backend and by the allocator that finds its size
    for index in range(CALLS // 4):
        uses[index % 3](simulator, actions)
    gc.collect()
    before = resident_memory()
    for index in range(CALLS):
        uses[index % 3](simulator, actions)
    gc.collect()
    assert resident_memory() - before < MOST_GROWTH


@pytest.mark.parametrize("use", [lambda trajectory: None, lambda trajectory: trajectory.positions.sum().backward()])
def test_a_trajectory_goes_with_the_last_reference_to_it(backend: str, use: Callable[[Trajectory], None]) -> None:
    simulator = make(backend)
    actions = torch.zeros(1, 1, 3, dtype=simulator.dtype, requires_grad=True)
    trajectory = differentiable_rollout(simulator, simulator.initial_state(), actions)
    use(trajectory)
    watched = {name: weakref.ref(getattr(trajectory, name)) for name in ("positions", "tool_poses")}
    watched["graph"] = weakref.ref(trajectory.positions.grad_fn)
    del trajectory
    assert [name for name, reference in watched.items() if reference() is not None] == []


@pytest.mark.filterwarnings("ignore:.*clay passes through tools:UserWarning")
@pytest.mark.parametrize("backend", BACKENDS)
def test_a_long_search_keeps_no_trajectory(backend: str, tmp_path: Path) -> None:
    """However many iterations a run makes, at most the last trajectory is there when the next one is made."""
    task = load_task(toy_fixtures.write_toy_task(tmp_path))
    task = task.model_copy(update={"scene": task.scene.model_copy(update={"substeps": 2, "grid_size": 16}), "stage_count": 1})
    alive: list[weakref.ref[object]] = []
    most = 0

    class Watched(backend_class(backend)):
        def rollout(self, state, actions):
            nonlocal most
            most = max(most, sum(reference() is not None for reference in alive))
            trajectory = super().rollout(state, actions)
            alive.append(weakref.ref(trajectory.positions))
            return trajectory

    optimizer = TrajectoryOptimizer(iterations=30, patience=30, pruner=PrunerNone())
    deform(task, simulator=Watched(task.scene, batch_size=4), placer="fixed", optimizer=optimizer)
    assert len(alive) >= 30
    assert most <= 1
    assert sum(reference() is not None for reference in alive) <= 1
