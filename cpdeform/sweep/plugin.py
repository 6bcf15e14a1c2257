"""Registers the kinds of jobs that plan, and the engines."""

from __future__ import annotations

from cpdeform.core.hookspecs import PluginSpec, hookimpl


@hookimpl
def cpdeform_jobs() -> list[PluginSpec]:
    """A run each."""
    return [PluginSpec(name="run", target="cpdeform.sweep.job_run:do_run", summary="one run, as by `cpdeform run`")]


@hookimpl
def cpdeform_engines() -> list[PluginSpec]:
    """Where workers run."""
    return [
        PluginSpec(name="local", target="cpdeform.sweep.engines.local:EngineLocal", summary="processes on this machine"),
        PluginSpec(
            name="ray",
            target="cpdeform.sweep.engines.ray:EngineRay",
            summary="tasks of a Ray cluster",
            extra="cpdeform[ray]",
        ),
        PluginSpec(
            name="slurm",
            target="cpdeform.sweep.engines.slurm:EngineSlurm",
            summary="an array of jobs of a Slurm cluster, through submitit",
            extra="cpdeform[slurm]",
        ),
    ]
