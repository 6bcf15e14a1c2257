"""Registers the strategy that the experiments have beside the built-in ones, and their runs as jobs."""

from __future__ import annotations

from cpdeform.core.hookspecs import PluginSpec, hookimpl


@hookimpl
def cpdeform_strategies() -> list[PluginSpec]:
    """The default strategy with settings for each of the paper's tasks."""
    return [
        PluginSpec(
            name="tuned",
            target="cpdeform.experiments.tuned:StrategyTuned",
            summary="the default with settings tuned for each of the paper's tasks, as in docs/results.md",
        )
    ]


@hookimpl
def cpdeform_jobs() -> list[PluginSpec]:
    """A run of an experiment."""
    return [
        PluginSpec(
            name="experiment",
            target="cpdeform.experiments.experiment_job:do_experiment_run",
            summary="one run of `cpdeform experiment`, with its figures",
        )
    ]
