"""`cpdeform report` and `cpdeform view`: the page of a run, as a file and live."""

from __future__ import annotations

import webbrowser
from pathlib import Path
from typing import Annotated

import typer

Record = Annotated[Path, typer.Argument(help="A run record, see `cpdeform run --out`.", metavar="DIR")]


def report(
    directory: Record,
    out: Annotated[Path | None, typer.Option(help="The HTML file. Defaults to report.html in the record.", metavar="FILE")] = None,
    losers: Annotated[int, typer.Option(help="Losing candidates of each stage to roll out again; 0 for none.", min=0)] = 2,
    evaluate: Annotated[
        bool, typer.Option("--evaluate/--no-evaluate", help="Compute the figures of `cpdeform evaluate` (half a minute).")
    ] = True,
    show: Annotated[bool, typer.Option("--open", help="Open the page in a browser.")] = False,
) -> None:
    """Write the page of a run: one HTML file with 3-D playback, losses, figures and configuration, to keep or to send around.

    It needs no server and no network.

    Examples:
      cpdeform report runs/star

      cpdeform report runs/star --out star.html --losers 0 --no-evaluate
    """
    from cpdeform.report.page.write import write_page

    path = write_page(directory, out, losers=losers, evaluate=evaluate, told=lambda line: typer.echo(f"{line} ...", err=True))
    typer.echo(f"{path}  ({path.stat().st_size / 1e6:.1f} MB)")
    if show:
        webbrowser.open(path.resolve().as_uri())


def draw(
    directory: Record,
    camera: Annotated[
        str, typer.Option(help="default, front, side, top, back, or azimuth and elevation in degrees.", metavar="NAME|A,E")
    ] = "default",
    what: Annotated[
        list[str] | None,
        typer.Option(help="picture, sheet, curves, mp4, gif or heights; repeatable. Defaults to the first four.", metavar="NAME"),
    ] = None,
) -> None:
    """Draw the pictures of a run into its record: picture, contact sheet of all stages, learning curves, animation.

    Examples:
      cpdeform draw runs/star

      cpdeform draw runs/star --what sheet --camera top
    """
    from cpdeform.core.errors import InputError
    from cpdeform.report.draw import PICTURES, USUAL, draw_chosen

    for name in what or ():
        if name not in PICTURES:
            raise InputError("--what", came=f'"{name}"', expected=", ".join(PICTURES))
    for path in draw_chosen(directory, tuple(what or USUAL), camera=camera):
        typer.echo(str(path))


def view(
    directory: Record,
    port: Annotated[int, typer.Option(help="Port on this machine; 0 for any free one.", min=0, max=65535)] = 0,
    show: Annotated[bool, typer.Option("--open", help="Open the page in a browser.")] = False,
) -> None:
    """Serve the page of a run while it goes on; stages appear as they are done. Only requests from this machine are answered.

    The directory may appear later. Control-C ends it.

    Examples:
      cpdeform run star --out runs/star & cpdeform view runs/star --open
    """
    from cpdeform.report.page.server import PageServer

    with PageServer(directory, port=port) as server:
        typer.echo(f"{server.address}  (control-C ends it)")
        if show:
            webbrowser.open(server.address)
        server.serve_forever()
