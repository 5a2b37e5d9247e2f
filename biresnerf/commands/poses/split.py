"""`biresnerf split INPUT --output PARTS`: a large set cut into parts, for several machines or several nights."""

from __future__ import annotations

import json
from pathlib import Path
from shlex import quote
from typing import Any

import click

from biresnerf.commands.answers import json_option, show
from biresnerf.commands.empty_folder import require_empty
from biresnerf.commands.settings_option import settings_option
from biresnerf.options.refine_options import parse_options


@click.command("split")
@click.argument("input_path", metavar="INPUT", type=click.Path(path_type=Path))
@click.option(
    "--output", "-o", required=True, type=click.Path(path_type=Path), help="Folder for the lists of photos."
)
@click.option("--most", type=int, default=None, help="Photos of each part, about; default: 400.")
@settings_option
@json_option
def split_command(
    input_path: Path, output: Path, most: int | None, settings: dict[str, Any], as_json: bool
) -> None:
    """Cut INPUT into parts of photos that see the same, a fifth of them shared with other parts.

    Writes the names of each part's photos to a file, and prints the commands that refine the parts, on as many machines
    as there are, and those that join them.
    """
    asked = parse_options(settings)
    from biresnerf.data.formats.read_dataset import read_dataset
    from biresnerf.data.parts.cut_set import PHOTOS
    from biresnerf.data.photos.video.video_frames import VideoReading
    from biresnerf.run.split_set import photos_of_parts

    dataset = read_dataset(input_path, videos=VideoReading(asked.video_frames))
    parts = photos_of_parts(dataset, asked, PHOTOS if most is None else most)
    require_empty(output)
    output.mkdir(parents=True, exist_ok=True)
    files, commands = [], []
    source = " ".join(
        [
            quote(str(input_path)),
            *(f"--set {quote(f'{key}={json.dumps(value)}')}" for key, value in settings.items()),
        ]
    )
    width = max(2, len(str(len(parts))))
    for number, photos in enumerate(parts, start=1):
        names = output / f"part-{number:0{width}}.txt"
        names.write_text("".join(f"{name}\n" for name in photos), "utf-8")
        files.append(names)
        result = output / "results" / names.stem
        commands.append(
            f"biresnerf refine {source} --photos-from {quote(str(names))} --output {quote(str(result))}"
        )
    join = f"biresnerf refine {source} --join {quote(str(output / 'results'))} --output OUT"
    found = {
        "photos": len(set().union(*parts)),
        "parts": [
            {"file": str(name), "photos": len(photos)} for name, photos in zip(files, parts, strict=True)
        ],
        "refine": commands,
        "join": join,
    }
    sizes = ", ".join(str(len(photos)) for photos in parts)
    lines = [f"# {found['photos']} photos in {len(parts)} parts of {sizes}", *commands, join]
    show(found, "\n".join(lines), as_json=as_json)
