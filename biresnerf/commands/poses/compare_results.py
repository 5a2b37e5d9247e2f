"""`biresnerf compare-results A B`: which of two results has the better poses, and by what."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from biresnerf.commands.answers import json_option, show, table

if TYPE_CHECKING:
    from biresnerf.comparison.conclusion import Comparison

_MARKS = {"first": ("better", ""), "second": ("", "better")}


@click.command("compare-results")
@click.argument("first", type=click.Path(path_type=Path))
@click.argument("second", type=click.Path(path_type=Path))
@json_option
def compare_results_command(first: Path, second: Path, as_json: bool) -> None:
    """Say which of two results, FIRST or SECOND, has the better poses, and by what; or why that cannot be known.

    Both are folders that `refine` wrote, of the same photos. The poses that were returned are compared, those in
    poses.json, after alignment. What differs is listed: measures, figures, options.
    """
    from biresnerf.comparison.compare_results import compare_results
    from biresnerf.data.formats.simple.poses_json import POSES, read_poses_json
    from biresnerf.viewer.report_html import read_report

    results = [(read_report(folder), read_poses_json(folder / POSES)) for folder in (first, second)]
    compared = compare_results(*results)
    show(compared, _text(compared, (first, second)), as_json=as_json)


def _text(compared: Comparison, folders: tuple[Path, Path]) -> str:
    lines = [compared.conclusion, *(f"  {ground}" for ground in compared.why)]
    if compared.figures:
        rows = [["", f"first: {folders[0]}", f"second: {folders[1]}"]]
        for figure in compared.figures:
            marks = _MARKS.get(figure.better or "", ("", ""))
            values = zip((figure.first, figure.second), marks, strict=True)
            rows.append([figure.name, *(f"{value} ({mark})" if mark else value for value, mark in values)])
        lines += ["", table(rows)]
    return "\n".join(lines)
