"""A folder of images alone: names, sizes, and a first guess of the lens. Nobody has said where they were taken."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from biresnerf.data.dataset import Camera, Dataset, Frame, SourceFormat
from biresnerf.data.image_files import read_header
from biresnerf.data.orientation import orientation_notes, page_notes
from biresnerf.data.transforms_json import refuse_too_few

GUESSED_FOCAL = 1.2  # of the long side, as COLMAP guesses: a field of view of 45 degrees, a normal lens


def read_image_folder(root: Path, images: Sequence[Path]) -> Dataset:
    """The images as frames without pose, named by their path relative to ``root``; one camera for each size.

    Raises:
        InputError: ``too_few_images``, or a code of `read_header`.
    """
    names = [path.relative_to(root).as_posix() for path in images]
    root = root.resolve()  # the name of "." is empty
    refuse_too_few(len(names), root.name)
    headers = [read_header(path, name) for path, name in zip(images, names, strict=True)]
    cameras: dict[Camera, int] = {}
    frames = []
    for name, header in zip(names, headers, strict=True):
        width, height = header.width, header.height
        focal = GUESSED_FOCAL * max(width, height)
        camera = Camera("SIMPLE_RADIAL", width, height, (focal, width / 2, height / 2, 0.0))
        index = cameras.setdefault(camera, len(cameras))
        frames.append(Frame(name, root / name, index, None, None))
    return Dataset(
        root,
        tuple(cameras),
        tuple(frames),
        SourceFormat("images", None, {}, np.eye(4)),
        (*orientation_notes(headers, [1] * len(headers), names), *page_notes(headers, names)),
        tuple("guessed" for _ in cameras),
    )
