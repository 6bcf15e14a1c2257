"""Registers the example backend and the example strategy."""

from __future__ import annotations

from cpdeform.core.hookspecs import PluginSpec, hookimpl


@hookimpl
def cpdeform_simulators() -> list[PluginSpec]:
    """Register the simulator `example`."""
    return [
        PluginSpec(
            name="example",
            target="cpdeform_example.simulator:SimulatorExample",
            summary="MLS-MPM in plain PyTorch, CPU, gradients by autograd; slow, for tests and as a tutorial",
        )
    ]


@hookimpl
def cpdeform_strategies() -> list[PluginSpec]:
    """Register the strategy `example`."""
    return [
        PluginSpec(
            name="example",
            target="cpdeform_example.strategy:StrategyExample",
            summary="a tutorial: a proposer, a phase and a pruner of one's own",
        )
    ]
