"""Registers the native simulator and the native transport solver."""

from __future__ import annotations

from cpdeform.core.hookspecs import PluginSpec, hookimpl

INSTALL = "cpdeform-native"


@hookimpl
def cpdeform_simulators() -> list[PluginSpec]:
    """Register the simulator `native`."""
    return [
        PluginSpec(
            name="native",
            target="cpdeform_native.simulator:SimulatorNative",
            summary="MLS-MPM in C++ for the CPU, vectorised and threaded, hand-written adjoints",
            extra=INSTALL,
            automatic={"cpu": 10},
        )
    ]


@hookimpl
def cpdeform_ot_solvers() -> list[PluginSpec]:
    """Register the transport solver `native`."""
    return [
        PluginSpec(
            name="native",
            target="cpdeform_native.ot:OTSolverNative",
            summary="Debiased Sinkhorn divergence in C++ for the CPU, converged, nothing of size N x M (CPU).",
            extra=INSTALL,
            automatic={"cpu": 10},
        )
    ]
