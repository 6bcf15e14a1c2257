"""Registers the Taichi backend."""

from __future__ import annotations

from cpdeform.core.hookspecs import PluginSpec, hookimpl


@hookimpl
def cpdeform_simulators() -> list[PluginSpec]:
    """Register the simulator `taichi`."""
    return [
        PluginSpec(
            name="taichi",
            target="cpdeform.backends.taichi.simulator:SimulatorTaichi",
            summary="MLS-MPM on Taichi, CPU and CUDA, hand-written adjoints",
            extra="cpdeform[taichi]",
            automatic={"cpu": 3, "cuda": 5},
        )
    ]
