"""`biresnerf export RESULT FORM...`: a finished result in further forms."""

from __future__ import annotations

from pathlib import Path
from typing import get_args

import click

from biresnerf.commands.answers import json_option, print_json
from biresnerf.options.refine_options import PackName


@click.command("export")
@click.argument("result", type=click.Path(path_type=Path))
@click.argument("forms", metavar="FORM...", nargs=-1, required=True, type=click.Choice(get_args(PackName)))
@click.option(
    "--photos",
    type=click.Path(path_type=Path),
    help="The input's folder, for forms that hold photos (pinhole).",
)
@click.option(
    "--output",
    "-o",
    type=click.Path(path_type=Path),
    help="Folder for the files. Default: the result's own.",
)
@json_option
def export_command(
    result: Path, forms: tuple[PackName, ...], photos: Path | None, output: Path | None, as_json: bool
) -> None:
    """Write a finished RESULT in the given forms beside those it has.

    docs/formats.md says what each form holds, and for which program it is.
    """
    from biresnerf.data.formats.read_result import read_result
    from biresnerf.data.formats.write_formats import ON_REQUEST

    refined = read_result(result, photos)
    folder = output or result
    for form in forms:
        ON_REQUEST[form](refined, folder, lambda: False)
        if not as_json:
            click.echo(f"{form} written to {folder}")
    if as_json:
        print_json({"folder": str(folder), "forms": list(forms)})
