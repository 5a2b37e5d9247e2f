"""What a folder holds: a transforms file, or images alone; and which of them is read."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from biresnerf.data.image_files import is_image_name
from biresnerf.errors import InputError

TRANSFORMS_NAMES = ("transforms.json", "transforms_train.json")
IMAGE_FOLDER = "images"
# Poses in forms that are not read; to seed over them in silence would throw the user's work away.
_FOREIGN_POSES = ("cameras.bin", "cameras.txt", "poses_bounds.npy")
_FOREIGN_FOLDERS = (".", "sparse/0", "sparse", "colmap/sparse/0", "sparse_txt", "sparse_txt/0")


@dataclass(frozen=True)
class FolderContents:
    """``transforms`` or else ``images`` is what is read; ``notes`` says what was passed over."""

    root: Path
    transforms: Path | None
    images: tuple[Path, ...]
    notes: tuple[str, ...]


def look_into(folder: Path) -> FolderContents:
    """Finds what to read in ``folder``: a transforms file, its images, or those in images/.

    A folder that holds nothing but one folder (an unpacked archive) stands for that folder.

    Raises:
        InputError: ``no_images`` or ``pose_format_unsupported``.
    """
    root = folder
    for _ in range(3):
        entries = [entry for entry in _visible(root) if entry.name != "__MACOSX"]
        if len(entries) != 1 or not entries[0].is_dir() or entries[0].name == IMAGE_FOLDER:
            break
        root = entries[0]
    present = [root / name for name in TRANSFORMS_NAMES if (root / name).is_file()]
    if present:
        others = [path.name for path in present[1:]]
        notes = (f"{present[0].name} was read and {others[0]} was not",) if others else ()
        return FolderContents(root, present[0], (), notes)
    images = _images_in(root) or _images_below(root / IMAGE_FOLDER)
    _refuse_foreign_poses(root)
    if not images:
        raise InputError(
            "no_images",
            "holds neither transforms.json nor images.",
            where=str(folder),
            mend="Put a transforms.json or images (PNG, JPEG, WebP, TIFF, BMP) there, or into images/.",
        )
    return FolderContents(root, None, tuple(images), ())


def _visible(folder: Path) -> list[Path]:
    try:
        return sorted(path for path in folder.iterdir() if not path.name.startswith("."))
    except OSError as error:
        raise InputError(
            "input_unreadable",
            f"cannot be read: {error.strerror}.",
            where=str(folder),
            mend="Check the path and its permissions.",
        ) from None


def _images_in(folder: Path) -> list[Path]:
    return [path for path in _visible(folder) if is_image_name(path) and path.is_file()]


def _images_below(folder: Path) -> list[Path]:
    found = []
    for parent, folders, files in os.walk(folder):
        folders[:] = [name for name in folders if not name.startswith(".")]
        found += [
            Path(parent, name) for name in files if not name.startswith(".") and is_image_name(Path(name))
        ]
    return sorted(found)


def _refuse_foreign_poses(root: Path) -> None:
    for folder in _FOREIGN_FOLDERS:
        for name in _FOREIGN_POSES:
            path = root / folder / name
            if path.is_file():
                raise InputError(
                    "pose_format_unsupported",
                    "poses in this form are not read.",
                    where=path.relative_to(root).as_posix(),
                    mend="Convert them to transforms.json (ns-process-data does), or give the images alone.",
                )
