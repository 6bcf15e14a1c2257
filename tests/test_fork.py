"""A forked child computes, or is refused clearly; it never waits for threads that only its parent has."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable
from typing import Any

import pytest
import torch

from cpdeform.core.forking import LocalThreads, prepare_for_forks
from cpdeform.core.plugins import load_registry
from cpdeform.core.scene import Scene

pytestmark = [
    pytest.mark.skipif(not hasattr(os, "fork"), reason="this system does not fork"),
    pytest.mark.filterwarnings("ignore:This process .* is multi-threaded:DeprecationWarning"),
]
PATIENCE = 60.0
REGISTRY = load_registry()
SIMULATORS = [name for name in ("warp", "taichi", "native") if name in REGISTRY.names("simulator")]
SOLVERS = [name for name in ("pot", "geomloss", "native") if name in REGISTRY.names("ot_solver")]
LARGE = 200
"""Points whose distances are more than torch computes in one thread."""


def make_simulator(name: str) -> Any:
    body = {"kind": "box", "position": (0.5, 0.2, 0.5), "widths": (0.2, 0.2, 0.2), "particle_count": 12000}
    scene = Scene.model_validate({"bodies": [body], "substeps": 2})
    # A process has one Taichi, with as many threads as whatever test started it wanted.
    return REGISTRY.create("simulator", name, scene=scene, threads=1 if name == "taichi" else 2)


def rollout(simulator: Any) -> float:
    trajectory = simulator.rollout(simulator.initial_state(), torch.zeros(1, 1, 0))
    gradient = simulator.vjp(trajectory, torch.ones_like(trajectory.positions))
    return float(trajectory.positions.double().sum() + gradient.initial_state.velocity.double().sum())


def make_solver(name: str) -> Any:
    return REGISTRY.create("ot_solver", name, blur=0.02)


def solve(solver: Any) -> float:
    generator = torch.Generator().manual_seed(0)
    source, target = (torch.rand(LARGE, 3, generator=generator) for _ in range(2))
    return float(solver.solve(source, target).value)


def in_child(work: Callable[[], object]) -> object:
    """What the work returns in a forked child, or its exception's text."""

    def send() -> None:
        try:
            connection.send(work())
        except Exception as error:
            connection.send(f"{type(error).__name__}: {error}")

    context = multiprocessing.get_context("fork")
    receiver, connection = context.Pipe(duplex=False)
    child = context.Process(target=send)
    child.start()
    try:
        assert receiver.poll(PATIENCE), "the child hangs"
        return receiver.recv()
    finally:
        child.kill()
        child.join()


@pytest.fixture(autouse=True)
def torch_with_threads() -> Any:
    """Make torch start its pool of threads, which a child then lacks."""
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    torch.rand(1 << 20).exp_()
    yield
    torch.set_num_threads(before)


@pytest.mark.parametrize("name", SIMULATORS)
def test_simulators_compute_in_a_child_or_refuse(name: str) -> None:
    simulator = make_simulator(name)
    expected = rollout(simulator)
    for work in (lambda: rollout(simulator), lambda: rollout(make_simulator(name))):
        came = in_child(work)
        if name == "taichi":
            assert str(came).startswith("TaichiRuntimeError: Taichi: this process runs what it was forked with")
        else:
            assert came == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("name", SOLVERS)
def test_solvers_compute_in_a_child(name: str) -> None:
    solver = make_solver(name)
    expected = solve(solver)
    for work in (lambda: solve(solver), lambda: solve(make_solver(name))):
        assert in_child(work) == pytest.approx(expected, rel=1e-6)


def test_a_trajectory_of_the_parent_is_gone_back_in_the_child() -> None:
    simulator = make_simulator("warp")
    trajectory = simulator.rollout(simulator.initial_state(), torch.zeros(1, 1, 0))

    def back() -> float:
        weights = torch.ones_like(trajectory.positions)
        return float(simulator.vjp(trajectory, weights).initial_state.velocity.double().sum())

    assert in_child(back) == pytest.approx(back(), rel=1e-6)


def test_torch_keeps_its_threads_in_the_parent_and_has_one_in_a_child() -> None:
    prepare_for_forks()
    assert in_child(torch.get_num_threads) == 1
    assert torch.get_num_threads() == 2


def test_pools_of_threads_are_made_anew_in_a_child() -> None:
    pool = LocalThreads(2)
    assert list(pool.map(abs, [-1, 2])) == [1, 2]
    assert in_child(lambda: [*pool.map(abs, [-3]), pool.submit(abs, -4).result()]) == [3, 4]
    assert pool.submit(abs, -5).result() == 5
