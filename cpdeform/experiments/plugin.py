"""Registers the strategy that the experiments have beside the built-in ones."""

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
