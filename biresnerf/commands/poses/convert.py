"""`biresnerf convert INPUT OUTPUT --to FORMAT`: poses from one format into others, nothing optimised."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from biresnerf.commands.answers import json_option, print_json
from biresnerf.commands.empty_folder import require_empty
from biresnerf.options.formats import formats

if TYPE_CHECKING:
    from biresnerf.data.formats.convert import Photos


@click.command("convert")
@click.argument("input_path", metavar="INPUT", type=click.Path(path_type=Path))
@click.argument("output", type=click.Path(path_type=Path))
@click.option(
    "--to", "names", required=True, multiple=True,
    type=click.Choice([name for name, one in formats().items() if one.in_set]), help="A format; may be repeated.",
)  # fmt: skip
@click.option(
    "--photos", type=click.Choice(["link", "copy", "none"]), default="link", show_default=True,
    help="How images and masks come into OUTPUT.",
)  # fmt: skip
@click.option(
    "--bounds", nargs=2, type=click.FloatRange(0, min_open=True), metavar="NEAR FAR",
    help="Of depth, in the set's units, for llff. Default: of the points that each image sees.",
)  # fmt: skip
@json_option
def convert_command(
    input_path: Path,
    output: Path,
    names: tuple[str, ...],
    photos: Photos,
    bounds: tuple[float, float] | None,
    as_json: bool,
) -> None:
    """Convert the poses of INPUT into other formats, without optimising anything.

    INPUT may have any format that `refine` reads; OUTPUT is a new folder. World, scale and names stay as they are.
    Images without a pose are left out and listed. docs/formats.md describes the formats. `export` converts results of
    `refine`.
    """
    require_empty(output)
    if bounds is not None and bounds[0] >= bounds[1]:
        raise click.BadParameter("NEAR must be less than FAR.", param_hint="--bounds")
    from biresnerf.data.formats.convert import convert
    from biresnerf.data.formats.read_dataset import read_dataset

    dataset = read_dataset(input_path)
    done = convert(dataset, tuple(dict.fromkeys(names)), output, photos, bounds)
    warnings = [*dataset.warnings, *done.notes]
    if as_json:
        print_json(_document(done.places, len(dataset) - len(done.left_out), done.left_out, warnings))
        return
    for name, place in done.places.items():
        click.echo(f"{name} in {os.path.relpath(place)}")
    if done.left_out:
        click.echo(f"left out, without a pose: {', '.join(done.left_out)}", err=True)
    for warning in warnings:
        click.echo(f"warning: {warning}", err=True)


def _document(
    places: dict[str, Path], images: int, left_out: tuple[str, ...], warnings: list[str]
) -> dict[str, Any]:
    return {
        "formats": {name: str(place) for name, place in places.items()},
        "images": images,
        "left_out": left_out,
        "warnings": warnings,
    }
