"""Commands of plugins: listed beside the built-in ones, imported on use."""

from __future__ import annotations

from typing import Any

import typer
from typer.core import TyperCommand, TyperGroup
from typer.main import get_command

from cpdeform.core.hookspecs import PluginSpec
from cpdeform.core.plugins import Registry, load_registry


class PluginCommand(TyperCommand):
    """Stands for a plugin's command in listings, until it is called.

    Args:
        spec: What the plugin says about it.
        registry: Where it is loaded from.
    """

    def __init__(self, spec: PluginSpec, registry: Registry) -> None:
        super().__init__(spec.name, help=spec.summary, short_help=spec.summary)
        self._registry = registry

    def make_context(self, info_name: str | None, args: list[str], parent: Any = None, **extra: Any) -> Any:
        """The context of the plugin's own command.

        Raises:
            PluginError: The command cannot be imported.
            MissingExtraError: An optional dependency is not installed.
        """
        function = self._registry.load("command", str(self.name))
        app = typer.Typer(add_completion=False, context_settings={"help_option_names": ["-h", "--help"]})
        app.command(name=self.name)(function)
        return get_command(app).make_context(info_name, args, parent=parent, **extra)


class PluginGroup(TyperGroup):
    """Commands, the built-in ones first: a plugin cannot take the place of one of them."""

    def list_commands(self, ctx: Any) -> list[str]:
        """Names of all commands."""
        return [*self.commands, *(name for name in _registry(ctx).names("command") if name not in self.commands)]

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """The command of a name; None where there is none. Plugins are looked for where no built-in command has it."""
        if cmd_name in self.commands:
            return self.commands[cmd_name]
        registry = _registry(ctx)
        known = cmd_name in registry.names("command")
        return PluginCommand(registry.find("command", cmd_name).spec, registry) if known else None


def _registry(ctx: Any) -> Registry:
    """The plugins, discovered once for each call of the command line."""
    registry: Registry = ctx.meta.setdefault(__name__, None) or load_registry()
    ctx.meta[__name__] = registry
    return registry
