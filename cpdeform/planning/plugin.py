"""Registers the built-in strategies and executors."""

from __future__ import annotations

from cpdeform.core.hookspecs import PluginSpec, hookimpl


@hookimpl
def cpdeform_strategies() -> list[PluginSpec]:
    """The default, the paper's algorithm, and a search that looks ahead."""
    return [
        PluginSpec(
            name="cpdeform",
            target="cpdeform.planning.strategies.cpdeform:StrategyCpdeform",
            summary="contact points discovery, candidates race each other (the default for tasks of one stage)",
        ),
        PluginSpec(
            name="paper",
            target="cpdeform.planning.strategies.paper:StrategyPaper",
            summary="Algorithm 1 of the paper to the letter",
        ),
        PluginSpec(
            name="sculpt",
            target="cpdeform.planning.strategies.sculpt:StrategySculpt",
            summary="many touches a stage, screened by rollouts, the best polished (the default for tasks of several stages)",
        ),
        PluginSpec(
            name="look-ahead",
            target="cpdeform.planning.strategies.look_ahead:StrategyLookAhead",
            summary="a beam over stages: several states go on, the best path is kept",
        ),
    ]


@hookimpl
def cpdeform_executors() -> list[PluginSpec]:
    """Where the candidates of a run are computed."""
    return [
        PluginSpec(
            name="processes",
            target="cpdeform.planning.executor_processes:ExecutorProcesses",
            summary="processes on this machine (the default)",
        ),
        PluginSpec(
            name="ray",
            target="cpdeform.planning.executor_ray:ExecutorRay",
            summary="tasks of a Ray cluster",
            extra="cpdeform[ray]",
        ),
    ]
