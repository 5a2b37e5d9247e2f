"""`biresnerf view OUT`: a result, or a run under way, in three dimensions in the browser."""

from __future__ import annotations

import threading
from pathlib import Path

import click

from biresnerf.errors import InputError


@click.command("view")
@click.argument("result", metavar="OUT", type=click.Path(path_type=Path))
@click.option(
    "--photos",
    type=click.Path(path_type=Path),
    help="The input: larger photos in the cameras, and photos while a run is under way.",
)
@click.option("--host", default="127.0.0.1", show_default=True, help="Address to listen on.")
@click.option(
    "--port",
    type=click.IntRange(1, 65535),
    default=8080,
    show_default=True,
    help="The next free one where it is taken.",
)
@click.option("--open", "open_page", is_flag=True, help="Open the view in a browser.")
def view_command(result: Path, photos: Path | None, host: str, port: int, open_page: bool) -> None:
    """Show the cameras of OUT in the browser, with their photos and points, until Ctrl-C.

    OUT is a folder that `refine` wrote, or is writing to: the cameras move as they are refined. Click on a camera to
    look through it. Anyone who reaches HOST sees the photos.
    """
    from biresnerf.live_view.live_view import LiveView
    from biresnerf.live_view.state import newest_poses

    if newest_poses(result) is None:
        raise InputError(
            "result_missing",
            "holds no result, and no run that shows poses yet.",
            where=str(result),
            hint="Name the output folder of `biresnerf refine`.",
        )
    view = LiveView(result, photos, host=host, port=port)
    click.echo(f"view at {view.url}  (Ctrl-C ends it)")
    if open_page:
        click.launch(view.url)
    try:
        view.follow(threading.Event())
    except KeyboardInterrupt:
        pass
    finally:
        view.stop()
