"""The program that validates a dataset: `python -m workers.check FOLDER`.

Writes one line of JSON to standard output: ``{"report": {...}}`` (exit status 0), or ``{"error":
{"code", "detail", "where", "mend"}}`` (exit status 2). It reads what strangers sent, so it confines itself
first: memory, CPU time, no files written. Loads neither torch nor pycolmap; poses that are missing are
found by the job, not here.
"""

from __future__ import annotations

import json
import os
import resource
import sys
from pathlib import Path
from typing import Any

from biresnerf.errors import InputError

EXIT_INPUT_ERROR = 2
# Address space: numpy and Pillow, and four decoders with pictures of up to 150 million pixels.
MEMORY_BYTES = 6 * 2**30
CPU_S = 3600
# Decoded in full, then kept as thumbnails: the check needs no pixels afterwards.
THUMBNAIL_PX = 16
IMAGES_MIN = 3


def main(folder: Path) -> int:
    """Check ``folder``; returns the exit status."""
    answer_to = os.dup(1)
    os.dup2(2, 1)  # whatever a library prints must not mix with the answer
    try:
        answer: dict[str, Any] = {"report": check(folder)}
        status = 0
    except InputError as error:
        where = error.where.replace(f"{folder}/", "").replace(str(folder), "the dataset")
        answer = {"error": {"code": error.code, "detail": error.what, "where": where, "mend": error.mend}}
        status = EXIT_INPUT_ERROR
    with os.fdopen(answer_to, "w") as out:
        out.write(json.dumps(answer) + "\n")
    return status


def check(folder: Path) -> dict[str, Any]:
    """Read everything in ``folder`` and decode every image; returns what was found.

    Raises:
        InputError: what is wrong, with which file, and the mend.
    """
    from biresnerf.data.folder import look_into
    from biresnerf.data.images import load_images
    from biresnerf.data.transforms_json import read_transforms

    contents = look_into(folder)
    if contents.transforms is None:
        return _check_images_alone(contents.root, contents.images)
    dataset = read_transforms(contents.transforms)
    for frame in dataset.frames:
        _require_inside(folder, frame.path, frame.name)
    images = load_images(dataset, THUMBNAIL_PX)
    return {
        "images": len(dataset),
        "cameras": len(dataset.cameras),
        "poses": "given",
        "format": dataset.source.dialect,
        "transparency": images.alpha is not None,
        "warnings": [*contents.notes, *dataset.warnings],
    }


def _check_images_alone(root: Path, images: tuple[Path, ...]) -> dict[str, Any]:
    from biresnerf.data.image_files import DAMAGED, open_image

    if len(images) < IMAGES_MIN:
        raise InputError(
            "too_few_images",
            f"{len(images)} images are too few; {IMAGES_MIN} is the least.",
            where="the dataset",
            mend="Send more images of the scene.",
        )
    for path in images:
        name = path.relative_to(root).as_posix()
        with open_image(path, name) as image:
            try:
                image.load()
            except DAMAGED as error:
                raise InputError(
                    "not_an_image", f"is damaged: {error}.", where=name, mend="Replace the file."
                ) from None
    return {"images": len(images), "cameras": None, "poses": "missing", "format": "images", "warnings": []}


def _require_inside(folder: Path, path: Path, name: str) -> None:
    """A frame must not name a file of somebody else on this machine."""
    if not path.resolve().is_relative_to(folder.resolve()):
        raise InputError(
            "unsafe_path",
            "names a file outside of the dataset.",
            where=name,
            mend="Name images by their path relative to transforms.json, inside what you send.",
        )


def confine() -> None:
    """Take no more than a check needs, whatever the files say."""
    for kind, amount in (
        (resource.RLIMIT_AS, MEMORY_BYTES),
        (resource.RLIMIT_CPU, CPU_S),
        (resource.RLIMIT_CORE, 0),
        (resource.RLIMIT_NOFILE, 256),
    ):
        _, most = resource.getrlimit(kind)
        wanted = amount if most == resource.RLIM_INFINITY else min(amount, most)
        resource.setrlimit(kind, (wanted, wanted))


if __name__ == "__main__":
    confine()
    sys.exit(main(Path(sys.argv[1])))
