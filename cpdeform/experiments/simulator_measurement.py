"""Time and memory of one simulator at one size; meant for a fresh process, see `cpdeform.experiments.worker`.

The scene is that of the task `writer`, a board of clay under a pen, with as many particles as asked for. The pen goes down into
the board and then wanders, differently in each world.
"""

from __future__ import annotations

import dataclasses
import math
import statistics
import time
from typing import Any

import torch
from torch import Tensor

from cpdeform.core.errors import UnknownNameError
from cpdeform.core.memory import MemoryGauge
from cpdeform.core.plugins import Registry, load_registry
from cpdeform.core.scene import Scene
from cpdeform.core.simulator import Simulator
from cpdeform.core.state import State
from cpdeform.core.task import load_task, merge, validate

TASK = "writer-v1"
DTYPES = {"float32": torch.float32, "float64": torch.float64}
PRESSING_STEPS = 3
MEGABYTE = 1e6


@dataclasses.dataclass(frozen=True, kw_only=True)
class SimulatorMeasurement:
    """What to measure.

    Attributes:
        backend: Registered name of the simulator.
        particles: Particles N of a world.
        worlds: Worlds B of the batch.
        device: ``"cpu"``, ``"cuda"`` or ``"cuda:N"``.
        dtype: ``"float32"`` or ``"float64"``; defaults to the first type that it declares.
        threads: Threads on the CPU, for simulators that have such an option.
        steps: Environment steps T of a rollout.
        repeat: Rollouts and gradients that are timed; with 0 only memory is measured.
        options: Further options of the simulator.
    """

    backend: str
    particles: int
    worlds: int
    device: str = "cpu"
    dtype: str | None = None
    threads: int = 1
    steps: int = 2
    repeat: int = 3
    options: dict[str, Any] = dataclasses.field(default_factory=dict)


def measure(request: dict[str, Any]) -> dict[str, Any]:
    """Measure what a request, the fields of a `SimulatorMeasurement`, asks for.

    Returns:
        ``dtype``; ``first_gradient_seconds`` from loading the backend to the first gradient of one step;
        ``forward_ms_per_substep`` and ``backward_ms_per_substep`` of all worlds together, medians;
        ``particle_substeps_per_second`` forwards and backwards, all worlds; in megabytes (1e6 bytes) ``peak_memory_mb``
        above what the process held before the simulator was built, ``rollout_memory_mb`` of rollout and gradient above what
        it held before them, and ``memory_estimate_mb``, which predicts the latter. What cannot be measured is None.

    Raises:
        CpdeformError: The backend cannot do it.
    """
    wanted = SimulatorMeasurement(**request)
    torch.set_num_threads(wanted.threads)
    scene, registry = board(wanted.particles), load_registry()
    begin = time.perf_counter()
    registry.load("simulator", wanted.backend)
    loading = time.perf_counter() - begin
    gauge = MemoryGauge(wanted.device)
    begin = time.perf_counter()
    simulator = _build(wanted, scene, registry)
    state = simulator.initial_state(batch_size=wanted.worlds)
    actions = wandering_actions(simulator, worlds=wanted.worlds, steps=wanted.steps)
    _run(simulator, state, actions[:, :1])
    first = loading + time.perf_counter() - begin
    peak, before = gauge.peak(), gauge.start
    simulator.release_memory()
    gauge.restart()
    _run(simulator, state, actions)
    rollout = gauge.peak()
    times = [_run(simulator, state, actions) for _ in range(wanted.repeat)]
    differentiable = simulator.capabilities.differentiable
    return {
        "dtype": str(simulator.dtype).removeprefix("torch."),
        **_speed(times, wanted, substeps=wanted.steps * scene.substeps, differentiable=differentiable),
        "peak_memory_mb": max(peak, rollout + gauge.start - before) / MEGABYTE,
        "rollout_memory_mb": rollout / MEGABYTE,
        "memory_estimate_mb": simulator.memory_estimate(wanted.steps, worlds=wanted.worlds) / MEGABYTE,
        "first_gradient_seconds": first if differentiable else None,
    }


def board(particles: int) -> Scene:
    """The scene of the task `writer` with so many particles."""
    scene = load_task(TASK).scene.model_dump()
    return validate(Scene, merge(scene, {"bodies": {"0": {"particle_count": particles}}}), source="bench scene")


def _build(wanted: SimulatorMeasurement, scene: Scene, registry: Registry) -> Simulator:
    options: dict[str, Any] = {"batch_size": wanted.worlds, "device": wanted.device, **wanted.options}
    if wanted.dtype is not None:
        if wanted.dtype not in DTYPES:
            raise UnknownNameError("--dtype", wanted.dtype, DTYPES)
        options["dtype"] = DTYPES[wanted.dtype]
    known = registry.option_names("simulator", wanted.backend)
    if known is not None and "threads" in known:
        options["threads"] = wanted.threads
    simulator: Simulator = registry.create("simulator", wanted.backend, scene=scene, **options)
    return simulator


def wandering_actions(simulator: Simulator, *, worlds: int, steps: int, seed: int = 0) -> Tensor:
    """Smooth random actions (B, T, A) of a tool that first goes down for `PRESSING_STEPS` steps."""
    generator = torch.Generator().manual_seed(seed)
    size = simulator.scene.action_size
    phase = 2.0 * math.pi * torch.rand(worlds, 1, size, 2, generator=generator, dtype=torch.float64)
    turn = 2.0 * math.pi * torch.arange(steps, dtype=torch.float64)[None, :, None] / 10.0
    actions = 0.3 * torch.sin(turn + phase[..., 0]) + 0.3 * torch.sin(0.5 * turn + phase[..., 1])
    actions[:, :, 1] *= 0.2
    actions[:, :PRESSING_STEPS, 1] -= 0.8
    return actions.clamp(-1.0, 1.0).to(device=simulator.device, dtype=simulator.dtype)


def _run(simulator: Simulator, state: State, actions: Tensor) -> tuple[float, float]:
    """Seconds of a rollout and of its gradient (0 where there is none); all that they made is gone afterwards."""
    _synchronize(simulator)
    begin = time.perf_counter()
    trajectory = simulator.rollout(state, actions)
    _synchronize(simulator)
    forward = time.perf_counter() - begin
    if not simulator.capabilities.differentiable:
        return forward, 0.0
    grad_positions = torch.full_like(trajectory.positions, 1.0 / trajectory.positions.shape[2])
    _synchronize(simulator)
    begin = time.perf_counter()
    gradient = simulator.vjp(trajectory, grad_positions)
    _synchronize(simulator)
    backward = time.perf_counter() - begin
    if not bool(torch.isfinite(gradient.actions).all()):
        raise ArithmeticError("the gradient is not finite")
    return forward, backward


def _synchronize(simulator: Simulator) -> None:
    if simulator.device.type == "cuda":
        torch.cuda.synchronize(simulator.device)


def _speed(
    times: list[tuple[float, float]], wanted: SimulatorMeasurement, *, substeps: int, differentiable: bool
) -> dict[str, float | None]:
    names = ("forward_ms_per_substep", "backward_ms_per_substep", "particle_substeps_per_second")
    if not times:
        return dict.fromkeys(names)
    forward, backward = (statistics.median(seconds) / substeps for seconds in zip(*times, strict=True))
    if not differentiable:
        return dict(zip(names, (1e3 * forward, None, None), strict=True))
    rate = wanted.particles * wanted.worlds / (forward + backward)
    return dict(zip(names, (1e3 * forward, 1e3 * backward, rate), strict=True))
