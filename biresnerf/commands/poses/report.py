"""`biresnerf report RESULT`: writes the report.html of a finished result again."""

from __future__ import annotations

import json
from pathlib import Path

import click

from biresnerf.errors import BiresnerfError


@click.command("report")
@click.argument("result", type=click.Path(path_type=Path))
@click.option("--title", help="Title of the page. Default: the number of images.")
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object: the file and its size.")
def report_command(result: Path, title: str | None, as_json: bool) -> None:
    """Write the report.html of RESULT again, from the files in it.

    The page shows the whole result and needs no network.
    """
    from biresnerf.viewer.report_html import REPORT_HTML, read_report, write_report_html

    notes = write_report_html(result, read_report(result), title)
    if notes:
        raise BiresnerfError(notes[0])
    page = result / REPORT_HTML
    if as_json:
        click.echo(json.dumps({"file": str(page), "bytes": page.stat().st_size}))
    else:
        click.echo(f"{page} written ({page.stat().st_size / 1e6:.1f} MB)")
