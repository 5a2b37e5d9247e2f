"""A folder of images alone: names, sizes, and a first guess of the lens. Nobody has said where they were taken."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from biresnerf.data.model.dataset import Camera, Dataset, Frame, IntrinsicsSource, SourceFormat
from biresnerf.data.model.safe_names import refuse_outside
from biresnerf.data.photos.guessed_lens import guess_lens
from biresnerf.data.photos.image_files import read_header
from biresnerf.data.photos.mask_files import mask_beside
from biresnerf.data.photos.named_images import refuse_too_few
from biresnerf.data.photos.orientation import orientation_notes, page_notes


def read_image_folder(root: Path, images: Sequence[Path], within: Path | None = None) -> Dataset:
    """The images as frames without pose, named by their path relative to ``root``; one camera for each size and
    focal length.

    Raises:
        InputError: ``too_few_images``, ``unsafe_path`` where a link leads out of ``within``, or a code of
            `read_header`.
    """
    names = [path.relative_to(root).as_posix() for path in images]
    if within is not None:
        refuse_outside(images, names, within, root.name)
    root = root.resolve()  # the name of "." is empty
    refuse_too_few(len(names), root.name)
    headers = [read_header(path, name) for path, name in zip(images, names, strict=True)]
    cameras: dict[Camera, int] = {}
    sources: dict[Camera, IntrinsicsSource] = {}
    frames = []
    for name, header in zip(names, headers, strict=True):
        camera, source = guess_lens(header)
        index = cameras.setdefault(camera, len(cameras))
        sources.setdefault(camera, source)
        mask, inverted = mask_beside(root, root / name, name, within)
        frames.append(Frame(name, root / name, index, None, None, mask=mask, mask_inverted=inverted))
    return Dataset(
        root,
        tuple(cameras),
        tuple(frames),
        SourceFormat("images", None, {}, np.eye(4)),
        (*orientation_notes(headers, [1] * len(headers), names), *page_notes(headers, names)),
        tuple(sources[camera] for camera in cameras),
    )
