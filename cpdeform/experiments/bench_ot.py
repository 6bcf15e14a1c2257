"""Time, accuracy and memory of transport solvers over sizes: every combination in a fresh process, one at a time."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Iterator
from typing import Any

from cpdeform.core.errors import InputError
from cpdeform.core.plugins import Registry
from cpdeform.experiments.ot_measurement import OTMeasurement
from cpdeform.experiments.worker import measured

MEASURE = "cpdeform.experiments.ot_measurement:measure"

MEASURED = (
    "cold_ms",
    "warm_ms",
    "cold_iterations",
    "converged",
    "cold_gradient_cosine",
    "warm_gradient_cosine",
    "reference",
    "value_error_against_exact",
    "peak_memory_mb",
)
"""What a row holds besides the combination it belongs to and `error`; see `ot_measurement.measure`."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class OTBenchSettings:
    """What to measure.

    Attributes:
        solvers: Registered names of transport solvers.
        points: Numbers of points of each cloud.
        threads: Numbers of threads.
        blur: Entropic blur, length units.
        device: ``"cpu"``, ``"cuda"`` or ``"cuda:N"``.
        steps: Warm calls.
        repeat: Cold solutions timed; the median counts.
        exact_points: Up to this many points the value is compared with the exact cost.
        timeout: Seconds after which a combination is given up.

    Raises:
        InputError: A number is out of range.
    """

    solvers: tuple[str, ...]
    points: tuple[int, ...]
    threads: tuple[int, ...]
    blur: float = 2e-3
    device: str = "cpu"
    steps: int = 10
    repeat: int = 1
    exact_points: int = 2000
    timeout: float = 600.0

    def __post_init__(self) -> None:
        for name in ("solvers", "points", "threads"):
            if not getattr(self, name):
                raise InputError(f"--{name}", came="nothing", expected="at least one entry")
        for name in ("points", "threads"):
            for number in getattr(self, name):
                if number < 1:
                    raise InputError(f"--{name}", came=str(number), expected="numbers of at least 1")
        for name in ("blur", "steps", "repeat", "timeout"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise InputError(f"--{name}", came=str(value), expected="a number above 0")
        if self.exact_points < 0:
            raise InputError("--exact-points", came=str(self.exact_points), expected="a number of at least 0")

    def combinations(self) -> list[OTMeasurement]:
        """Every combination, small ones first for each solver."""
        return [
            OTMeasurement(
                solver=solver,
                points=points,
                threads=threads,
                blur=self.blur,
                device=self.device,
                steps=self.steps,
                repeat=self.repeat,
                exact_points=self.exact_points,
            )
            for solver, threads, points in itertools.product(self.solvers, self.threads, sorted(self.points))
        ]


def default_solvers(registry: Registry) -> tuple[str, ...]:
    """All registered transport solvers that are installed with what they need."""
    return tuple(registry.installed("ot_solver"))


def bench_ot(settings: OTBenchSettings, *, registry: Registry) -> Iterator[dict[str, Any]]:
    """Measure every combination, one at a time.

    Args:
        settings: What to measure.
        registry: Where the names of the solvers are looked up.

    Returns:
        A row each, as it is ready. A combination that cannot run is a row, too, with the reason in ``error``.

    Raises:
        UnknownNameError: No plugin registers one of the names; raised before anything is measured.
    """
    for name in settings.solvers:
        registry.find("ot_solver", name)
    return (measure_row(combination, timeout=settings.timeout) for combination in settings.combinations())


def measure_row(measurement: OTMeasurement, *, timeout: float) -> dict[str, Any]:
    """Measure one combination in a fresh process.

    Args:
        measurement: The combination.
        timeout: Seconds after which it is given up.

    Returns:
        The combination's fields, those of `MEASURED`, and ``error``, None or why there are no figures.
    """
    row: dict[str, Any] = {name: getattr(measurement, name) for name in ("solver", "device", "blur", "threads", "points")}
    row |= dict.fromkeys(MEASURED)
    return measured(row, MEASURE, dataclasses.asdict(measurement), threads=measurement.threads, timeout=timeout)
