"""Passes what happens in a run on to the observer hooks of the plugins."""

from __future__ import annotations

import warnings

import pluggy

from cpdeform.planning.result import DeformResult, Observer, Revision, StageResult


class HookObserver(Observer):
    """Calls `cpdeform_stage_finished`, `cpdeform_stages_revised` and `cpdeform_run_finished` of every plugin.

    A plugin that only watches must not cost the user hours of computation: what it raises becomes a `RuntimeWarning` that
    names the plugin, the other plugins are still called, and the run goes on.

    Args:
        manager: Holds the plugins, see `cpdeform.core.plugins.Registry.manager`.
    """

    def __init__(self, manager: pluggy.PluginManager) -> None:
        self._manager = manager

    def stage_finished(self, result: StageResult) -> None:
        """Call `cpdeform_stage_finished`."""
        self._call("cpdeform_stage_finished", result)

    def stages_revised(self, revision: Revision) -> None:
        """Call `cpdeform_stages_revised`."""
        self._call("cpdeform_stages_revised", revision)

    def run_finished(self, result: DeformResult) -> None:
        """Call `cpdeform_run_finished`."""
        self._call("cpdeform_run_finished", result)

    def _call(self, hook: str, result: StageResult | Revision | DeformResult) -> None:
        plugins = self._manager.get_plugins()
        for plugin in plugins:
            others = [other for other in plugins if other is not plugin]
            try:
                self._manager.subset_hook_caller(hook, remove_plugins=others)(result=result)
            except KeyboardInterrupt:
                raise
            except BaseException as error:
                name = self._manager.get_name(plugin)
                message = f"plugin {name}: {hook} failed with {type(error).__name__}: {error}. The run goes on."
                warnings.warn(message, RuntimeWarning, stacklevel=2)
