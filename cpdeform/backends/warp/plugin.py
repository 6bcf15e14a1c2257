"""Registers the Warp backend."""

from __future__ import annotations

from cpdeform.core.hookspecs import PluginSpec, hookimpl


@hookimpl
def cpdeform_simulators() -> list[PluginSpec]:
    """Register the simulator `warp`."""
    return [
        PluginSpec(
            name="warp",
            target="cpdeform.backends.warp.simulator:SimulatorWarp",
            summary="MLS-MPM on NVIDIA Warp, CPU and CUDA, hand-written adjoints",
            extra="cpdeform[warp]",
            automatic={"cpu": 5, "cuda": 10},
        )
    ]
