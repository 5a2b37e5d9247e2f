"""What a folder holds: poses in one of the forms that are read, or images alone; and which of them is read."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from biresnerf.data.formats.colmap.read_model import MODEL_FOLDERS, model_forms
from biresnerf.data.photos.named_images import IMAGE_FOLDER, images_below, images_in, visible
from biresnerf.errors import InputError

PoseForm = Literal["transforms", "colmap", "llff", "bundler", "metashape", "trajectory"]
TRANSFORMS_NAMES = ("transforms.json", "transforms_train.json")
LLFF_NAME = "poses_bounds.npy"
BUNDLER_NAMES = ("bundle.out", "bundle/bundle.out", "bundle.rd.out")
TRAJECTORY_NAMES = (
    *("trajectory.txt", "tum.txt", "kitti.txt", "poses.txt", "groundtruth.txt"),
    *("CameraTrajectory.txt", "KeyFrameTrajectory.txt"),
)
_METASHAPE_HEAD_BYTES = 4096


@dataclass(frozen=True)
class FolderContents:
    """What is read: the poses in ``poses`` (a file, or a COLMAP model's folder), or ``images`` where there are none.

    ``root`` is the folder that images lie in or below; ``notes`` says what was passed over.
    """

    root: Path
    form: PoseForm | None
    poses: Path | None
    images: tuple[Path, ...]
    notes: tuple[str, ...]

    @property
    def transforms(self) -> Path | None:
        """The transforms file, where that is what is read."""
        return self.poses if self.form == "transforms" else None


def look_into(folder: Path) -> FolderContents:
    """Finds what to read in ``folder``: poses in the first form that is there, else its images, or those in images/.

    The order is that of `PoseForm`. A folder that holds nothing but one folder (an unpacked archive) stands for it.

    Raises:
        InputError: ``no_images`` where it holds neither.
    """
    root = folder
    for _ in range(3):
        entries = [entry for entry in visible(root) if entry.name != "__MACOSX"]
        if len(entries) != 1 or not entries[0].is_dir() or entries[0].name == IMAGE_FOLDER:
            break
        root = entries[0]
    found = list(_pose_sources(root))
    if found:
        form, path = found[0]
        inside = form == "colmap" and path == root
        return FolderContents(_root_of_model(path) if inside else root, form, path, (), _notes(root, found))
    images = images_in(root) or images_below(root / IMAGE_FOLDER)
    if not images:
        raise InputError(
            "no_images",
            "holds neither transforms.json nor images.",
            where=str(folder),
            hint="Put poses or images (PNG, JPEG, WebP, TIFF, BMP) there, or the images into images/.",
        )
    return FolderContents(root, None, None, tuple(images), ())


def look_at(file: Path) -> FolderContents:
    """What the user means by naming one file with poses: the form by its name, images beside it.

    Raises:
        InputError: ``input_unsupported``.
    """
    suffix, folder = file.suffix.lower(), file.parent
    if suffix == ".json":
        return FolderContents(folder, "transforms", file, (), ())
    if suffix in (".bin", ".txt") and file.stem in ("cameras", "images", "points3D", "rigs", "frames"):
        return FolderContents(_root_of_model(folder), "colmap", folder, (), ())
    forms: dict[str, PoseForm] = {
        ".npy": "llff",
        ".out": "bundler",
        ".xml": "metashape",
        ".txt": "trajectory",
    }
    if suffix not in forms:
        raise InputError(
            "input_unsupported",
            "is neither a folder nor a file with poses that is read.",
            where=file.name,
            hint="Give a transforms.json, or a folder that holds poses or images.",
        )
    below = suffix == ".out" and folder.name == "bundle"
    return FolderContents(folder.parent if below else folder, forms[suffix], file, (), ())


def usual_name(file: Path) -> str | None:
    """The name under which `look_into` finds such a file in its folder; None where it is one of several files."""
    form = look_at(file).form
    names: dict[PoseForm | None, str] = {
        "transforms": TRANSFORMS_NAMES[0],
        "llff": LLFF_NAME,
        "bundler": BUNDLER_NAMES[0],
        "metashape": "cameras.xml",
        "trajectory": TRAJECTORY_NAMES[0],
    }
    return names.get(form)


def _pose_sources(root: Path) -> Iterator[tuple[PoseForm, Path]]:
    """All poses in ``root``, the form that is preferred first."""
    yield from (("transforms", root / name) for name in TRANSFORMS_NAMES if (root / name).is_file())
    yield from (("colmap", root / name) for name in MODEL_FOLDERS if model_forms(root / name))
    if (root / LLFF_NAME).is_file():
        yield "llff", root / LLFF_NAME
    yield from (("bundler", root / name) for name in BUNDLER_NAMES if (root / name).is_file())
    yield from (("metashape", path) for path in visible(root) if _is_metashape(path))
    yield from (("trajectory", root / name) for name in TRAJECTORY_NAMES if (root / name).is_file())


def _notes(root: Path, found: list[tuple[PoseForm, Path]]) -> tuple[str, ...]:
    if len(found) == 1:
        return ()
    read, *others = (path.relative_to(root).as_posix() for _, path in found)
    were = "was not" if len(others) == 1 else "were not"
    return (f"{read} was read and {', '.join(others)} {were}",)


def _is_metashape(path: Path) -> bool:
    if path.suffix.lower() != ".xml" or not path.is_file():
        return False
    with path.open("rb") as file:
        return b"<chunk" in file.read(_METASHAPE_HEAD_BYTES)


def _root_of_model(folder: Path) -> Path:
    """The folder that holds a model's folder as COLMAP, nerfstudio and 3DGS lay it out, images/ beside it."""
    parts = Path(os.path.abspath(folder)).parts
    tails = [Path(name).parts for name in MODEL_FOLDERS]
    roots = [folder] + [Path(*parts[: -len(tail)]) for tail in tails if tail and parts[-len(tail) :] == tail]
    with_images = (root for root in roots if (root / IMAGE_FOLDER).is_dir() or images_in(root))
    return next(with_images, roots[-1])
