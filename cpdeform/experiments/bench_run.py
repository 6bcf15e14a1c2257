"""Whole runs over simulators and transport solvers: what they cost and what they reach, each in a fresh process."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator
from typing import Any

from cpdeform.core.errors import InputError
from cpdeform.core.memory import MemoryGauge
from cpdeform.core.plugins import Registry, load_registry
from cpdeform.experiments.worker import measured
from cpdeform.run.configuration import RunConfiguration

RUN = "cpdeform.experiments.bench_run:run"
MEGABYTE = 1e6
ITERATION_PARTS = ("rollout", "objective", "vjp", "optimizer")
STAGE_PARTS = ("transport", "placement", "optimization", "execution")
MEASURED = (
    "loss_initial",
    "loss_final",
    "loss_ratio",
    "metric",
    "metric_value",
    "gradient_evaluations",
    "seconds",
    *(f"{part}_seconds" for part in STAGE_PARTS),
    *(f"{part}_ms_per_iteration" for part in ITERATION_PARTS),
    "peak_memory_mb",
)
"""What a row holds besides the combination it belongs to and `error`."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class RunBenchSettings:
    """What to run.

    Attributes:
        task: Registered name or path of a YAML file.
        backends: Registered names of simulators, or ``"auto"``.
        solvers: Registered names of transport solvers, or ``"auto"``.
        seeds: Seeds.
        threads: Threads of torch and, where it takes such an option, of the simulator.
        device: ``"cpu"``, ``"cuda"`` or ``"cuda:N"``.
        iterations: The most gradient steps per stage.
        stages: Number of stages; defaults to the task's own.
        timeout: Seconds after which a run is given up.

    Raises:
        InputError: A list is empty or a number out of range.
    """

    task: str
    backends: tuple[str, ...]
    solvers: tuple[str, ...]
    seeds: tuple[int, ...]
    threads: int
    device: str = "cpu"
    iterations: int = 30
    stages: int | None = None
    timeout: float = 3600.0

    def __post_init__(self) -> None:
        for name in ("backends", "solvers", "seeds"):
            if not getattr(self, name):
                raise InputError(f"--{name}", came="nothing", expected="at least one entry")
        for name in ("threads", "iterations", "timeout"):
            if not getattr(self, name) > 0:
                raise InputError(f"--{name}", came=str(getattr(self, name)), expected="a number above 0")

    def configurations(self, *, registry: Registry) -> list[RunConfiguration]:
        """Every combination, with the names that ``"auto"`` stands for."""
        return [
            RunConfiguration.model_validate(
                {
                    "task": self.task,
                    "backend": backend,
                    "ot": solver,
                    "seed": seed,
                    "device": self.device,
                    "stages": self.stages,
                    "optimizer": {"iterations": self.iterations},
                    "simulator_options": _threads(registry, backend, self.threads),
                }
            )
            for backend, solver, seed in itertools.product(
                [registry.resolve("simulator", name, device=self.device) for name in self.backends],
                [registry.resolve("ot_solver", name, device=self.device) for name in self.solvers],
                self.seeds,
            )
        ]


def _threads(registry: Registry, backend: str, threads: int) -> dict[str, int]:
    known = registry.option_names("simulator", backend)
    return {"threads": threads} if known is not None and "threads" in known else {}


def bench_run(settings: RunBenchSettings, *, registry: Registry) -> Iterator[dict[str, Any]]:
    """Run every combination, one at a time.

    Args:
        settings: What to run.
        registry: Where names are looked up.

    Returns:
        A row each, as it is ready. A combination that cannot run is a row, too, with the reason in ``error``.

    Raises:
        UnknownNameError: No plugin registers one of the names; raised before anything runs.
        MissingExtraError: A simulator's optional dependency is not installed.
    """
    configurations = settings.configurations(registry=registry)
    return (_row(configuration, settings) for configuration in configurations)


def _row(configuration: RunConfiguration, settings: RunBenchSettings) -> dict[str, Any]:
    row: dict[str, Any] = {name: getattr(configuration, name) for name in ("task", "backend", "device", "seed")}
    row |= {"solver": configuration.ot, "threads": settings.threads, **dict.fromkeys(MEASURED)}
    request = configuration.model_dump(mode="json", exclude_unset=True)
    return measured(row, RUN, request, threads=settings.threads, timeout=settings.timeout)


def run(request: dict[str, Any]) -> dict[str, Any]:
    """Run what a request, the fields of a `RunConfiguration`, describes; the parts are loaded before the clock starts.

    Returns:
        The fields of `MEASURED`: losses in objective units, wall time of the run and of its parts, the parts of an iteration as
        means over all iterations, peak memory in megabytes (1e6 bytes) above what the process held before.
    """
    from cpdeform.run.record_files import to_json
    from cpdeform.run.resolve import resolve

    configuration = RunConfiguration.model_validate(request)
    registry = load_registry()
    for kind, name in (("simulator", configuration.backend), ("ot_solver", configuration.ot)):
        registry.load(kind, name)
    gauge = MemoryGauge(configuration.device)
    result = resolve(configuration, registry=registry).run()
    history = [iteration for stage in result.stages for iteration in stage.history]
    stage_seconds = {part: sum(stage.seconds.get(part, 0.0) for stage in result.stages) for part in STAGE_PARTS}
    iteration_seconds = {part: sum(item.seconds.get(part, 0.0) for item in history) for part in ITERATION_PARTS}
    memory = result.memory
    peaks = [gauge.peak(), *([memory.peak] if memory is not None and memory.peak is not None else [])]
    return {
        name: to_json(value)
        for name, value in {
            "loss_initial": result.loss_initial,
            "loss_final": result.loss_final,
            "loss_ratio": result.loss_final / result.loss_initial if result.loss_initial else None,
            "metric": result.metric_name,
            "metric_value": result.metric_value,
            "gradient_evaluations": result.gradient_evaluations,
            "seconds": result.seconds,
            **{f"{part}_seconds": value for part, value in stage_seconds.items()},
            **{f"{part}_ms_per_iteration": 1e3 * value / max(len(history), 1) for part, value in iteration_seconds.items()},
            "peak_memory_mb": max(peaks) / MEGABYTE,
        }.items()
    }
