"""Poses of files that describe one image a row: a bad row costs one image its pose, not the set."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.formats.bad_frames import attempt
from biresnerf.data.formats.colmap.model_checks import camera_of_numbers
from biresnerf.data.formats.parsed_poses import FrameCamera, LensOf, ParsedPoses, PoseEntry
from biresnerf.data.model.dataset import SourceFormat
from biresnerf.data.photos.image_files import ImageHeader
from biresnerf.data.photos.photo_folders import images_in
from biresnerf.errors import InputError
from biresnerf.geometry.camera.camera_models import Camera, FullParameters, smallest_model

MAX_ROWS = 100_000
MAX_SKEW = 1e-3  # of the focal length: a third of a pixel at the corner of a photo of 640 px
Lens: TypeAlias = Camera | LensOf | None
# ``world_from_cam`` [4, 4] (OpenCV axes) or None, and the lens.
Placed: TypeAlias = tuple[NDArray[np.float64] | None, Lens]
# The image's name, the place in the file, and what reads the row. Raises InputError.
Row: TypeAlias = tuple[str, str, Callable[[], Placed]]


def parsed_rows(
    dialect: str,
    files: Sequence[Path],
    rows: Iterable[Row],
    *,
    notes: Sequence[str] = (),
    take_file_names: bool = False,
    photo_folders: Sequence[str] = (),
) -> ParsedPoses:
    """The poses of ``rows``; a row that cannot be read keeps its problem.

    Raises:
        InputError: ``duplicate_image`` for a name that two rows have, ``pose_file_invalid`` for too many rows.
    """
    entries = tuple(entry_of(*row) for row in rows)
    twice = [name for name, count in Counter(entry.name for entry in entries).items() if count > 1]
    if twice:
        second = [entry for entry in entries if entry.name == twice[0]][1]
        detail = f"{twice[0]!r} is there twice."
        raise InputError("duplicate_image", detail, where=second.where, hint="Remove one.")
    if len(entries) > MAX_ROWS:
        hint = "Split the set."
        raise InputError("pose_file_invalid", f"more than {MAX_ROWS} poses.", where=files[0].name, hint=hint)
    return ParsedPoses(
        SourceFormat(dialect, files=tuple(files)),
        entries,
        notes=tuple(notes),
        take_file_names=take_file_names,
        photo_folders=tuple(photo_folders),
    )


def entry_of(name: str, where: str, read: Callable[[], Placed]) -> PoseEntry:
    """The entry of one row. Raises InputError ``unsafe_path`` only; another is its problem."""
    found = attempt(read)
    if isinstance(found, InputError):
        return PoseEntry(name, None, where, problem=found)
    pose, lens = found
    return PoseEntry(name, pose, where, lens)


def lens_of(full: FullParameters, where: str, size: tuple[int, int]) -> Camera:
    """The lens in the smallest model that holds it. Raises InputError ``intrinsics_invalid``."""
    model, params = smallest_model(full, None)
    return camera_of_numbers(model, *size, params, where)


def pinhole_of(matrix: NDArray[np.float64], where: str, first_pixel: float) -> Callable[[int, int], Camera]:
    """The pinhole lens of an intrinsic matrix [3, 3] (or [4, 4]) at a width and a height.

    Args:
        first_pixel: where the matrix has the middle of the first pixel: at 0, or at 0.5 as here.

    Raises:
        InputError: ``camera_model_unsupported`` for skew; ``intrinsics_invalid``.
    """
    fx, fy, cx, cy = (float(matrix[at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2)))
    if abs(float(matrix[0, 1])) > MAX_SKEW * abs(fx):
        raise InputError(
            "camera_model_unsupported",
            f"the skew ({float(matrix[0, 1]):.3g} px) is not zero, and no supported camera model has it.",
            where=where,
            hint="Give undistorted images with square pixels.",
        )
    shift = 0.5 - first_pixel
    full = FullParameters(fx, fy, cx + shift, cy + shift)
    return lambda width, height: lens_of(full, where, (width, height))


def at_size_of(make: Callable[[int, int], Camera]) -> LensOf:
    """A lens that depends on the image's width and height."""

    def at_size(header: ImageHeader, _name: str) -> FrameCamera:
        return FrameCamera(make(header.width, header.height))

    return at_size


def folder_with_photos(file: Path) -> Path:
    """The folder of ``file``, or the one above it where only that one holds photos or images/."""
    for folder in (file.parent, file.parent.parent):
        if (folder / "images").is_dir() or images_in(folder):
            return folder
    return file.parent
