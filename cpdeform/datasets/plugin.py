"""Registers the plans of data sets as jobs."""

from __future__ import annotations

from cpdeform.core.hookspecs import PluginSpec, hookimpl


@hookimpl
def cpdeform_jobs() -> list[PluginSpec]:
    """A plan for a generated goal."""
    return [
        PluginSpec(
            name="dataset",
            target="cpdeform.datasets.job_plan:do_plan",
            summary="a plan for a generated goal, for `cpdeform dataset`",
        )
    ]
