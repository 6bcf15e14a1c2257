"""Registers the task files of this package."""

from __future__ import annotations

from cpdeform.core.hookspecs import PluginSpec, hookimpl


@hookimpl
def cpdeform_tasks() -> list[PluginSpec]:
    """Register the built-in tasks."""
    return [PluginSpec(name="writer", target="cpdeform.tasks:writer.yaml", summary="Press a pen into a board of clay")]
