"""Registers the built-in optimal-transport solvers; imports neither of them."""

from __future__ import annotations

from cpdeform.core.hookspecs import PluginSpec, hookimpl


@hookimpl
def cpdeform_ot_solvers() -> list[PluginSpec]:
    """Register POT and GeomLoss."""
    return [
        PluginSpec(
            name="pot",
            target="cpdeform.ot.pot:OTSolverPOT",
            summary="Python Optimal Transport: annealed Sinkhorn potentials, optionally the exact transport cost (CPU).",
            extra="cpdeform[pot]",
            automatic={"cpu": 1},
        ),
        PluginSpec(
            name="geomloss",
            target="cpdeform.ot.geomloss:OTSolverGeomLoss",
            summary="GeomLoss: debiased Sinkhorn divergence, converged, or with the settings of the paper (CPU, GPU).",
            extra="cpdeform[geomloss]",
            automatic={"cpu": 5, "cuda": 5},
        ),
    ]
