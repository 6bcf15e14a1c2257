"""Time and memory of simulators over sizes: every combination in a fresh process, one at a time."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator, Sequence
from typing import Any

from cpdeform.core.errors import InputError, UnknownNameError
from cpdeform.core.plugins import Registry
from cpdeform.experiments.simulator_measurement import DTYPES, SimulatorMeasurement
from cpdeform.experiments.worker import measured

MEASURE = "cpdeform.experiments.simulator_measurement:measure"
SLOW = ("example",)
"""Simulators that are measured only if they are named: oracles, not made to be fast."""

MEASURED = (
    "dtype",
    "forward_ms_per_substep",
    "backward_ms_per_substep",
    "particle_substeps_per_second",
    "peak_memory_mb",
    "rollout_memory_mb",
    "memory_estimate_mb",
    "first_gradient_seconds",
)
"""What a row holds besides the combination it belongs to and `error`; see `simulator_measurement.measure`."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class SimulatorBenchSettings:
    """What to measure.

    Attributes:
        backends: Registered names of simulators.
        particles: Numbers of particles of a world.
        worlds: Numbers of worlds of a batch.
        threads: Numbers of threads.
        device: ``"cpu"``, ``"cuda"`` or ``"cuda:N"``.
        dtype: ``"float32"`` or ``"float64"``; defaults to the first type that a simulator declares.
        steps: Environment steps of a rollout.
        repeat: Rollouts and gradients timed; the median counts.
        timeout: Seconds after which a combination is given up.

    Raises:
        InputError: A number is out of range.
        UnknownNameError: There is no such type.
    """

    backends: tuple[str, ...]
    particles: tuple[int, ...]
    worlds: tuple[int, ...]
    threads: tuple[int, ...]
    device: str = "cpu"
    dtype: str | None = None
    steps: int = 2
    repeat: int = 3
    timeout: float = 600.0

    def __post_init__(self) -> None:
        for name in ("backends", "particles", "worlds", "threads"):
            if not getattr(self, name):
                raise InputError(f"--{name}", came="nothing", expected="at least one entry")
        for name in ("particles", "worlds", "threads"):
            for number in getattr(self, name):
                if number < 1:
                    raise InputError(f"--{name}", came=str(number), expected="numbers of at least 1")
        for name in ("steps", "repeat", "timeout"):
            if not getattr(self, name) > 0:
                raise InputError(f"--{name}", came=str(getattr(self, name)), expected="a number above 0")
        if self.dtype is not None and self.dtype not in DTYPES:
            raise UnknownNameError("--dtype", self.dtype, DTYPES)

    def combinations(self) -> list[SimulatorMeasurement]:
        """Every combination, small ones first for each backend."""
        return [
            SimulatorMeasurement(
                backend=backend,
                particles=particles,
                worlds=worlds,
                threads=threads,
                device=self.device,
                dtype=self.dtype,
                steps=self.steps,
                repeat=self.repeat,
            )
            for backend, threads, particles, worlds in itertools.product(
                self.backends, self.threads, sorted(self.particles), sorted(self.worlds)
            )
        ]


def default_backends(registry: Registry) -> tuple[str, ...]:
    """All registered simulators that are installed with what they need and have a gradient, but for the slow oracles."""
    found = registry.installed("simulator").items()
    return tuple(name for name, simulator in found if name not in SLOW and simulator.capabilities.differentiable)


def bench_simulators(settings: SimulatorBenchSettings, *, registry: Registry) -> Iterator[dict[str, Any]]:
    """Measure every combination, one at a time.

    Args:
        settings: What to measure.
        registry: Where the names of the simulators are looked up.

    Returns:
        A row each, as it is ready. A combination that cannot run is a row, too, with the reason in ``error``.

    Raises:
        UnknownNameError: No plugin registers one of the names; raised before anything is measured.
    """
    check_backends(settings.backends, registry=registry)
    return (measure_row(combination, timeout=settings.timeout) for combination in settings.combinations())


def check_backends(names: Sequence[str], *, registry: Registry) -> None:
    """Raise `UnknownNameError` unless all simulators are registered."""
    for name in names:
        registry.find("simulator", name)


def measure_row(measurement: SimulatorMeasurement, *, timeout: float) -> dict[str, Any]:
    """Measure one combination in a fresh process.

    Args:
        measurement: The combination.
        timeout: Seconds after which it is given up.

    Returns:
        The combination's fields, those of `MEASURED`, and ``error``, None or why there are no figures.
    """
    row: dict[str, Any] = {name: getattr(measurement, name) for name in ("backend", "device", "dtype", "threads")}
    row |= {"particles": measurement.particles, "worlds": measurement.worlds}
    row |= {name: row.get(name) for name in MEASURED}
    return measured(row, MEASURE, dataclasses.asdict(measurement), threads=measurement.threads, timeout=timeout)
