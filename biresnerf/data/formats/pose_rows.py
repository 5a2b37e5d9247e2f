"""Poses of files that describe one image a row: a bad row costs one image its pose, not the set."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.formats.bad_frames import attempt
from biresnerf.data.formats.bind_images import in_order
from biresnerf.data.formats.colmap.model_checks import camera_of_numbers, listed_name, rigid_pose
from biresnerf.data.formats.parsed_poses import Assignment, FrameCamera, LensOf, ParsedPoses, PoseEntry
from biresnerf.data.model.colmap_scene import matrix_of_pose
from biresnerf.data.model.conventions import OPENCV_FROM_OPENGL
from biresnerf.data.model.dataset import SourceFormat
from biresnerf.data.model.pose_validation import rigid_matrix
from biresnerf.data.model.untrusted_file import invalid_file
from biresnerf.data.photos.image_files import ImageHeader
from biresnerf.data.photos.photo_folders import images_in
from biresnerf.errors import InputError
from biresnerf.geometry.camera.camera_models import Camera, FullParameters, smallest_model
from biresnerf.geometry.rigid import rigid_inverse
from biresnerf.options.formats import Format

MAX_ROWS = 100_000
LEAST_SKEW_PX = 0.5  # at the upper and lower edge; less is left out
MOST_SHEAR = 0.1  # of a scanned film; cameras have a thousandth
ORDER_HINT = "Leave just the images that the poses are for; their order by name decides."
Lens: TypeAlias = Camera | LensOf | None
# ``world_from_cam`` [4, 4] (OpenCV axes) or None, and the lens.
Placed: TypeAlias = tuple[NDArray[np.float64] | None, Lens]
# The image's name, the place in the file, and what stands there.
Row: TypeAlias = tuple[str, str, Any]


def parsed_rows(
    form: Format,
    files: Sequence[Path],
    rows: Iterable[Row],
    read: Callable[[Any, str], Placed],
    *,
    notes: Sequence[str] = (),
    take_file_names: bool = False,
    photo_folders: Sequence[str] = (),
    in_order_of_names: Literal["natural", "as text"] | None = None,
    order_hint: str = ORDER_HINT,
) -> ParsedPoses:
    """The poses of ``rows``; a row that cannot be read keeps its problem.

    Args:
        form: the format of the rows.
        read: gives pose and lens of what stands at a place. Raises InputError.
        in_order_of_names: given where rows name no images, but are in the order of their names; says which order.
        order_hint: for a message where the number of images differs.

    Raises:
        InputError: ``duplicate_image`` for a name that two rows have, ``pose_file_invalid`` for too many rows.
    """
    rows = list(rows)
    if len(rows) > MAX_ROWS:
        raise invalid_file(files[0].name, f"more than {MAX_ROWS} poses.", "Split the set.")
    entries = tuple(entry_of(name, where, partial(read, value, where)) for name, where, value in rows)
    twice = [name for name, count in Counter(entry.name for entry in entries).items() if count > 1]
    if twice:
        second = [entry for entry in entries if entry.name == twice[0]][1]
        detail = f"{twice[0]!r} is there twice."
        raise InputError("duplicate_image", detail, where=second.where, hint="Remove one.")

    def in_order_of(names: Sequence[str]) -> Assignment:
        as_text = in_order_of_names == "as text"
        return in_order(entries, names, files[0].name, order_hint, as_text=as_text)

    return ParsedPoses(
        SourceFormat(form.name, files=tuple(files)),
        entries,
        assign=in_order_of if in_order_of_names else None,
        named=in_order_of_names is None,
        notes=tuple(notes),
        take_file_names=take_file_names,
        photo_folders=tuple(photo_folders),
    )


def named_rows(values: list[Any], place: str, key: str, hint: str) -> list[Row]:
    """A list's objects with the names of images that they have under a key; `parsed_rows` reads the rest.

    Raises:
        InputError: ``pose_file_invalid`` for one without a name, ``unsafe_path``.
    """
    rows: list[Row] = []
    for index, value in enumerate(values):
        where = f"{place}[{index}]"
        name = value.get(key) if isinstance(value, dict) else None
        if not isinstance(name, str):
            raise invalid_file(where, f"has no {key}.", hint)
        rows.append((listed_name(name, f"{where}.{key}"), where, value))
    return rows


def entry_of(name: str, where: str, read: Callable[[], Placed]) -> PoseEntry:
    """The entry of one row. Raises InputError ``unsafe_path`` only; any other becomes its problem."""
    found = attempt(read)
    if isinstance(found, InputError):
        return PoseEntry(name, None, where, problem=found)
    pose, lens = found
    return PoseEntry(name, pose, where, lens)


def pose_by(form: Format, matrix: Any, where: str) -> NDArray[np.float64]:
    """``world_from_cam`` [4, 4], OpenCV axes, of a file's matrix in the direction and with the axes of its format.

    Args:
        matrix: [3, 4] or [4, 4], as an array or as JSON has it.

    Raises:
        InputError: as `rigid_matrix` does.
    """
    rows = matrix.tolist() if isinstance(matrix, np.ndarray) else matrix
    return _as_declared(form, rigid_matrix(rows, where)[0])


def pose_of_numbers(
    form: Format, quaternion: Sequence[float], position: Sequence[float], where: str, hint: str
) -> NDArray[np.float64]:
    """`pose_by` of a quaternion, in the order of its format, and a translation. Raises InputError as `rigid_pose`."""
    a, b, c, d = quaternion
    quat_wxyz = (d, a, b, c) if form.quaternion == "xyzw" else (a, b, c, d)
    return _as_declared(form, matrix_of_pose(rigid_pose((*quat_wxyz, *position), where, hint)))


def _as_declared(form: Format, pose: NDArray[np.float64]) -> NDArray[np.float64]:
    world_from_cam = rigid_inverse(pose) if form.cam_from_world else pose
    return world_from_cam @ (OPENCV_FROM_OPENGL if form.axes == "opengl" else np.eye(4))


def lens_of(full: FullParameters, where: str, size: tuple[int, int]) -> Camera:
    """The lens in the smallest model that holds it. Raises InputError ``intrinsics_invalid``."""
    model, params = smallest_model(full, None)
    return camera_of_numbers(model, *size, params, where)


def lens_of_shares(lens: FullParameters, where: str) -> Callable[[int, int], Camera]:
    """A lens whose lengths are shares of the picture's longer side, from its centre, at a width and a height.

    Raises:
        InputError: ``intrinsics_invalid``.
    """

    def at(width: int, height: int) -> Camera:
        size = max(width, height)
        cx, cy = lens.cx * size + width / 2, lens.cy * size + height / 2
        return lens_of(
            lens._replace(fx=lens.fx * size, fy=lens.fy * size, cx=cx, cy=cy), where, (width, height)
        )

    return at


def pinhole_of(matrix: NDArray[np.float64], where: str, first_pixel: float) -> Callable[[int, int], Camera]:
    """The pinhole lens of an intrinsic matrix [3, 3] (or [4, 4]) at a width and a height.

    Args:
        first_pixel: where the matrix has the middle of the first pixel: at 0, or at 0.5 as here.

    Raises:
        InputError: ``intrinsics_invalid``.
    """
    fx, fy, cx, cy = (float(matrix[at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2)))
    shift = 0.5 - first_pixel
    full = FullParameters(fx, fy, cx + shift, cy + shift)
    shear = shear_of(float(matrix[0, 1]), fy, where)
    return lambda width, height: without_skew(lens_of(full, where, (width, height)), shear, where)


def shear_of(skew_px: float, focal_y: float, where: str) -> float:
    """How far skew moves x for each pixel of y. Raises InputError ``intrinsics_invalid`` where no camera has as much.

    Args:
        skew_px: by which x grows with the distorted y / z.
    """
    shear = skew_px / focal_y if focal_y else 0.0
    if not abs(shear) <= MOST_SHEAR:
        raise InputError(
            "intrinsics_invalid",
            f"a skew of {skew_px:.3g} px is none that a camera has.",
            where=where,
            hint="Give the intrinsics that the images were taken with.",
        )
    return shear


def without_skew(camera: Camera, shear: float, where: str) -> Camera:
    """A camera, given without its skew, for photos that are straightened: see `Camera.shear`.

    Raises:
        InputError: ``intrinsics_invalid``.
    """
    if abs(shear) * camera.height / 2 <= LEAST_SKEW_PX:
        return camera
    full = camera.full()
    straight = full._replace(cx=full.cx + shear * (camera.height / 2 - full.cy))
    model, params = smallest_model(straight, camera.model)
    return replace(camera_of_numbers(model, camera.width, camera.height, params, where), shear=shear)


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
