"""`biresnerf export RESULT FORMAT...`: a finished result in further formats."""

from __future__ import annotations

from pathlib import Path

import click

from biresnerf.commands.answers import json_option, print_json
from biresnerf.options.formats import PosesOf, formats


@click.command("export")
@click.argument("result", type=click.Path(path_type=Path))
@click.argument(
    "names", metavar="FORMAT...", nargs=-1, required=True,
    type=click.Choice([name for name, one in formats().items() if one.on_request]),
)  # fmt: skip
@click.option(
    "--photos",
    type=click.Path(path_type=Path),
    help="The input's folder, for formats that hold photos (pinhole).",
)
@click.option(
    "--output", "-o", type=click.Path(path_type=Path), help="Folder for the files. Default: the result's own."
)
@click.option(
    "--poses-of",
    type=click.Choice(["camera", "body"]),
    default="camera",
    show_default=True,
    help="body: into body/, the poses of the robot's flange, phone or other body whose poses the input had.",
)
@json_option
def export_command(
    result: Path,
    names: tuple[str, ...],
    photos: Path | None,
    output: Path | None,
    poses_of: PosesOf,
    as_json: bool,
) -> None:
    """Write a finished RESULT in the given formats, beside those it has.

    docs/formats.md says what each format holds, and which program reads it.
    """
    from biresnerf.data.formats.codec import WriteContext
    from biresnerf.data.formats.result_formats import export_result, read_result

    refined = read_result(result, photos)
    folder = output or result
    written, notes = export_result(refined, folder, names, WriteContext(), poses_of)
    if as_json:
        print_json({"folder": str(folder), "formats": written, "warnings": notes})
        return
    for name in written:
        click.echo(f"{name} written to {folder}")
    for note in notes:
        click.echo(f"warning: {note}", err=True)
