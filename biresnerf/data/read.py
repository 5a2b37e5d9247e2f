"""Any input a user may give, read and validated: the one door into `biresnerf.data`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from biresnerf.data.dataset import Dataset
from biresnerf.data.folder import look_into
from biresnerf.data.image_folder import read_image_folder
from biresnerf.data.transforms_json import read_transforms
from biresnerf.errors import InputError


def read_dataset(path: Path, within: Path | None = None) -> Dataset:
    """Reads a transforms file, a folder with one, or a folder of images, whose frames then have no pose.

    Everything is validated but the pixels, which `biresnerf.data.images.load_images` decodes.
    `biresnerf.data.seed_colmap.seed_poses` finds poses that are missing.

    Args:
        path: a transforms.json (nerfstudio, instant-ngp or Blender dialect) or a folder.
        within: refuse images outside of this folder; for files of strangers.

    Raises:
        InputError: the input cannot be used; says the file, the field and the mend.
    """
    path = Path(path)
    if path.is_file():
        _refuse_other_files(path)
        return read_transforms(path, within)
    if not path.is_dir():
        raise InputError(
            "input_missing", "does not exist.", where=str(path), mend="Give a folder or a transforms.json."
        )
    contents = look_into(path)
    if contents.transforms is not None:
        dataset = read_transforms(contents.transforms, within)
        return replace(dataset, warnings=contents.notes + dataset.warnings)
    return read_image_folder(contents.root, contents.images)


def _refuse_other_files(path: Path) -> None:
    if path.suffix.lower() != ".json":
        raise InputError(
            "input_unsupported",
            "is neither a folder nor a .json file.",
            where=path.name,
            mend="Give a transforms.json, or a folder that holds one or the images.",
        )
