"""Any input a user may give, read and validated: the one door into `biresnerf.data`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from biresnerf.data.formats.folder import FolderContents, look_at, look_into
from biresnerf.data.formats.image_folder import read_image_folder
from biresnerf.data.formats.registry import codecs
from biresnerf.data.model.dataset import Dataset
from biresnerf.data.photos.masks import refuse_unfit_mask
from biresnerf.errors import InputError


def read_dataset(path: Path, within: Path | None = None) -> Dataset:
    """Reads poses in any form that docs/formats.md names, with their images, or a folder of images alone.

    Everything is validated but the pixels, which `photos.images.load_images` decodes. Frames may lack poses:
    `seeding.seed_poses` finds them.

    Args:
        path: a folder, or the file in it that has the poses.
        within: refuse files outside of this folder; for files of strangers.

    Raises:
        InputError: the input cannot be used; says the file, the field and a hint.
    """
    contents = find_input(Path(path))
    if contents.format is None or contents.poses is None:
        dataset = read_image_folder(contents.root, contents.images, within)
    else:
        read = codecs()[contents.format].read
        assert read is not None, "only formats that are read are found"
        dataset = read(contents.root, contents.poses, within)
    for index, frame in enumerate(dataset.frames):
        refuse_unfit_mask(frame, dataset.camera_of(index))
    return replace(dataset, warnings=contents.notes + dataset.warnings)


def find_input(path: Path) -> FolderContents:
    """What of ``path`` is read. Raises InputError where nothing is there that can be."""
    if path.is_file():
        return look_at(path)
    if path.is_dir():
        return look_into(path)
    raise InputError(
        "input_missing", "does not exist.", where=str(path), hint="Give a folder, or a file with poses."
    )
