"""The command `cpdeform`."""

from __future__ import annotations

import sys
import warnings
from typing import Annotated, Any, TextIO

import typer

from cpdeform import __version__
from cpdeform.cli.bench import bench
from cpdeform.cli.check import check
from cpdeform.cli.dataset import dataset
from cpdeform.cli.doctor import doctor
from cpdeform.cli.evaluate import evaluate
from cpdeform.cli.experiment import experiment
from cpdeform.cli.help_texts import unwrap_help
from cpdeform.cli.interruption import exit_code, interruptible
from cpdeform.cli.plugin_commands import PluginGroup
from cpdeform.cli.plugins import plugins
from cpdeform.cli.recorded import config, replay, verify
from cpdeform.cli.report import draw, report, view
from cpdeform.cli.run import run
from cpdeform.cli.strategies import strategies
from cpdeform.cli.sweep import sweep
from cpdeform.cli.system_limits import system_limit
from cpdeform.cli.task import task
from cpdeform.cli.tasks import tasks
from cpdeform.core.errors import CpdeformError


class ErrorGroup(PluginGroup):
    """Commands whose deliberate errors, and limits of the system, are one message on stderr and exit code 2; all else is a bug."""

    def invoke(self, ctx: Any) -> Any:
        """Run the chosen command."""
        try:
            with warnings.catch_warnings():
                warnings.showwarning = _show_warning
                return super().invoke(ctx)
        except CpdeformError as error:
            typer.echo(f"cpdeform: error: {error}", err=True)
            raise typer.Exit(2) from error
        except OSError as error:
            if (line := system_limit(error)) is None:
                raise
            typer.echo(f"cpdeform: error: {line}", err=True)
            raise typer.Exit(2) from error
        except (MemoryError, RuntimeError) as error:
            if not isinstance(error, MemoryError) and "allocate memory" not in str(error) and "out of memory" not in str(error):
                raise
            # Torch raises a RuntimeError where the memory does not suffice.
            remedy = "Take fewer particles, steps, or worlds at a time (--set simulator_options.batch_size=1)."
            typer.echo(f"cpdeform: error: not enough memory. {remedy}", err=True)
            raise typer.Exit(2) from error
        except KeyboardInterrupt as error:
            typer.echo("cpdeform: interrupted", err=True)
            raise typer.Exit(exit_code(error)) from error


def _show_warning(
    message: Warning | str, category: type[Warning], filename: str, lineno: int, file: TextIO | None = None, line: str | None = None
) -> None:
    """Show a warning as a line of text, without the place in the source."""
    typer.echo(f"cpdeform: warning: {message}", file=file or sys.stderr)


app = typer.Typer(
    cls=ErrorGroup,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
app.command()(run)
app.command()(report)
app.command()(view)
app.command()(draw)
app.command()(evaluate)
app.command()(config)
app.command()(replay)
app.command()(verify)
app.command()(doctor)
app.command()(tasks)
app.command()(strategies)
app.command()(experiment)
app.command()(plugins)
app.add_typer(task, name="task")
app.add_typer(sweep, name="sweep")
app.add_typer(dataset, name="dataset")
app.add_typer(bench, name="bench")
app.add_typer(check, name="check")
unwrap_help(app)


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"cpdeform {__version__}")
        raise typer.Exit


@app.callback()
def callback(
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version and exit.")
    ] = False,
) -> None:
    """Plan how robot tools sculpt soft, clay-like bodies."""


def main() -> None:
    """Entry point of the command line.

    It exits with 0, 1 (a run without result), 2 (unusable input), or where it was interrupted 130 (control-C), 143 (SIGTERM) or
    129 (SIGHUP).
    """
    with interruptible():
        app(prog_name="cpdeform")


if __name__ == "__main__":
    main()
