"""The hooks of the entry-point group `cpdeform`: what a plugin can register and observe."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import pluggy

hookspec = pluggy.HookspecMarker("cpdeform")
hookimpl = pluggy.HookimplMarker("cpdeform")


@dataclasses.dataclass(frozen=True)
class PluginSpec:
    """A part that a plugin offers, described without importing it.

    Attributes:
        name: The name that users type, lower case, e.g. ``"warp"``.
        target: ``"module:attribute"`` of the class (of the YAML file for a task: ``"module:file.yaml"``), imported on use.
        summary: One line for listings.
        extra: What to install when the target's imports are missing, e.g. ``"cpdeform[warp]"``.
        automatic: Device types on which the name ``"auto"`` may stand for this part, each with a rank: of the parts that can be
            imported the one with the highest rank is taken. The built-in parts have ranks up to 10.
    """

    name: str
    target: str
    summary: str
    extra: str = ""
    automatic: Mapping[str, int] = dataclasses.field(default_factory=dict)


@hookspec
def cpdeform_simulators() -> list[PluginSpec]:  # type: ignore[empty-body]
    """Register subclasses of `cpdeform.core.simulator.Simulator`."""


@hookspec
def cpdeform_ot_solvers() -> list[PluginSpec]:  # type: ignore[empty-body]
    """Register subclasses of `cpdeform.core.ot.OTSolver`, whose constructors take the keyword `blur` (length units)."""


@hookspec
def cpdeform_placers() -> list[PluginSpec]:  # type: ignore[empty-body]
    """Register subclasses of `cpdeform.core.placer.Placer`."""


@hookspec
def cpdeform_tasks() -> list[PluginSpec]:  # type: ignore[empty-body]
    """Register task files."""


@hookspec
def cpdeform_strategies() -> list[PluginSpec]:  # type: ignore[empty-body]
    """Register subclasses of `cpdeform.planning.strategy.Strategy`."""


@hookspec
def cpdeform_jobs() -> list[PluginSpec]:  # type: ignore[empty-body]
    """Register kinds of jobs of sweeps: functions of a `cpdeform.sweep.job.JobContext` that return a job's figures."""


@hookspec
def cpdeform_engines() -> list[PluginSpec]:  # type: ignore[empty-body]
    """Register subclasses of `cpdeform.sweep.engine.Engine`, which run the workers of a sweep."""


@hookspec
def cpdeform_executors() -> list[PluginSpec]:  # type: ignore[empty-body]
    """Register executors (`cpdeform.planning.executor.Executor`), which compute the candidates of a run.

    They are context managers, made with the keywords `workers` and `threads` (of each worker).
    """


@hookspec
def cpdeform_commands() -> list[PluginSpec]:  # type: ignore[empty-body]
    """Register commands of the command line: functions whose annotated parameters Typer reads, such as `cpdeform.cli.run.run`.

    ``name="rl"`` becomes `cpdeform rl`. The function is imported when the command is called; errors that it raises on purpose
    (`cpdeform.core.errors.CpdeformError`) are told in a line, as those of the built-in commands are.
    """


@hookspec
def cpdeform_stage_finished(result: Any) -> None:
    """Observe a finished stage, a `cpdeform.planning.result.StageResult`."""


@hookspec
def cpdeform_stages_revised(result: Any) -> None:
    """Observe finished stages that got other plans, a `cpdeform.planning.result.Revision`."""


@hookspec
def cpdeform_run_finished(result: Any) -> None:
    """Observe a finished run, a `cpdeform.planning.result.DeformResult`."""
