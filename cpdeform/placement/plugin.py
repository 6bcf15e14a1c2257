"""Registers the built-in placers."""

from __future__ import annotations

from cpdeform.core.hookspecs import PluginSpec, hookimpl


@hookimpl
def cpdeform_placers() -> list[PluginSpec]:
    """The placers that come with this package."""
    return [
        PluginSpec(
            name="transport",
            target="cpdeform.placement.transport:PlacerTransport",
            summary="one tool at the contact point that optimal transport discovers (the paper's method)",
        ),
        PluginSpec(
            name="touch",
            target="cpdeform.placement.touches.placer:PlacerTouch",
            summary="many random touches where clay has far to go, to be screened; then variations of the best",
        ),
        PluginSpec(
            name="fixed",
            target="cpdeform.placement.fixed:PlacerFixed",
            summary="tools stay where they are (PlasticineLab)",
        ),
        PluginSpec(
            name="random",
            target="cpdeform.placement.random:PlacerRandom",
            summary="one tool at random points of the body's surface (the paper's ablation)",
        ),
    ]
