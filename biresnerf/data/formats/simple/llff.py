"""LLFF's ``poses_bounds.npy``: one row of 17 numbers an image, images by the order of their names."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.formats.codec import Codec, LensLimits, WriteContext
from biresnerf.data.formats.parsed_poses import ParsedPoses
from biresnerf.data.formats.pose_rows import Placed, parsed_rows, pose_by
from biresnerf.data.model.array_file import HEAD_BYTES, npy_numbers
from biresnerf.data.model.atomic_file import whole_file
from biresnerf.data.model.refined_set import RefinedSet
from biresnerf.data.model.untrusted_file import invalid_file, read_bytes, refuse_not_finite
from biresnerf.errors import InputError
from biresnerf.geometry.camera.camera_models import Camera
from biresnerf.options.formats import Format

LLFF = Format(
    name="llff",
    title="LLFF",
    rank=50,
    found_as=("poses_bounds.npy",),
    suffixes=(".npy",),
    gives="poses, one focal length an image",
    checked_against="two real sets",
    in_set="poses_bounds.npy",
    needs=("images folder", "bounds"),
    loses=("names", "some lenses", "distortion", "rigs", "points", "mask paths"),
    heading="For LLFF",
    hint="In the format of the input",
)


# LLFF's own shares of the points in front of a camera that may lie before and behind its bounds, percent.
_NEAREST, _FARTHEST = 0.1, 99.9
MAX_IMAGES = 100_000
_LENSES = LensLimits(
    "LLFF",
    (),
    fisheye=None,
    two_focal_lengths=False,
    off_centre=False,
    hint="Convert to pinhole, which undistorts the photos, then that folder to llff.",
)
_COLUMNS = 17
_HINT = "Write it again with numpy.save, 17 numbers a row."


def parse_llff(_root: Path, file: Path) -> ParsedPoses:
    """Poses and focal lengths of ``file``, for images in the order of their names.

    A row is a matrix 3 x 5, whose columns are the camera's axes down, right and back, its centre, and height, width and
    focal length (px); then two bounds of depth, which are not used.
    """
    rows = [(str(index), f"{file.name} row {index}", row) for index, row in enumerate(_rows(file))]
    return parsed_rows(LLFF, [file], rows, _read_row, in_order_of_names="as text")


def _read_row(row: NDArray[np.float64], where: str) -> Placed:
    refuse_not_finite(row, where, _HINT)
    down, right, back, centre, (height, width, focal) = row[:15].reshape(3, 5).T
    pose = pose_by(LLFF, np.stack([right, down, -back, centre], axis=1), where)
    return pose, _camera(height, width, focal, where)


def _camera(height: float, width: float, focal: float, where: str) -> Camera:
    whole = 0 < width < 1e6 and 0 < height < 1e6 and width == round(width) and height == round(height)
    if not whole or not 1e-3 * max(width, height) < focal < 1e5 * max(width, height):
        raise InputError(
            "intrinsics_invalid",
            f"{width:g} x {height:g} px with a focal length of {focal:g} px is no camera.",
            where=where,
            hint="Give height, width and focal length in pixels in the fifth column.",
        )
    return Camera("SIMPLE_PINHOLE", int(width), int(height), (float(focal), width / 2, height / 2))


def _rows(file: Path) -> NDArray[np.float64]:
    """The rows, float64 [n, 17]. Raises InputError ``pose_file_invalid``."""
    content = read_bytes(file, HEAD_BYTES + MAX_IMAGES * _COLUMNS * 8)
    rows = npy_numbers(content, file.name, _HINT)
    if rows.ndim != 2 or rows.shape[1] != _COLUMNS or len(rows) > MAX_IMAGES:
        raise invalid_file(file.name, f"holds something other than rows of {_COLUMNS} numbers.", _HINT)
    return rows


def rows_by_name(refined: RefinedSet) -> list[int]:
    """The images in the order of their files' names, in which readers of a format without names take them."""
    return sorted(range(len(refined)), key=lambda index: refined.images[index].file_name)


def given_bounds(file: Path, count: int) -> NDArray[np.float64]:
    """The depth bounds [count, 2] in the ``poses_bounds.npy`` of an input with ``count`` images.

    Raises:
        ValueError: the file does not have a row for each image.
    """
    rows = np.load(file, allow_pickle=False)
    if rows.shape != (count, 17):
        raise ValueError(f"{file.name} has shape {rows.shape}, not a row for each of {count} images")
    return np.asarray(rows[:, 15:], dtype=np.float64)


def write_llff(refined: RefinedSet, path: Path, bounds: NDArray[np.float64] | None = None) -> None:
    """Writes the set in the order of its files' names.

    Args:
        bounds: nearest and farthest depth [n, 2] of the images; default: those of the points that each image sees.

    Raises:
        InputError: ``export_not_possible``: a lens that the format cannot hold; ``bounds_missing``: no points are seen.
    """
    _LENSES.refuse(refined.cameras, "llff")
    if bounds is None:
        bounds = np.array([_bounds_of_points(refined, index) for index in range(len(refined))])
    write_poses_bounds(refined, bounds, path)


def _bounds_of_points(refined: RefinedSet, index: int) -> tuple[float, float]:
    """The depths between which the image sees all points but a thousandth at either end."""
    model = refined.model
    seen = model.points.track_image_ids == refined.image_ids[index]
    pose = refined.world_from_cam[index]
    depths = (model.points.xyz[model.points.owner[seen]] - pose[:3, 3]) @ pose[:3, 2]
    depths = depths[depths > 0]
    if not len(depths):
        raise InputError(
            "bounds_missing",
            "sees no points to take its depth bounds from.",
            where=refined.images[index].name,
            hint="Give the nearest and farthest depth: --bounds NEAR FAR.",
        )
    near, far = np.percentile(depths, (_NEAREST, _FARTHEST)).tolist()
    return near, far


def write_poses_bounds(refined: RefinedSet, bounds: NDArray[np.float64], path: Path) -> None:
    """A row for each image, in the order of the files' names; ``bounds`` [n, 2] are in the set's order.

    The fifth column is height, width and focal length (px) of the images as they are.
    """
    order = rows_by_name(refined)
    rows = np.empty((len(order), 17))
    rows[:, 15:] = bounds[order]
    for row, index in zip(rows, order, strict=True):
        camera = refined.camera_of(index)
        right, down, ahead, centre = refined.images[index].world_from_cam[:3].T
        lens = np.array([camera.height, camera.width, (camera.full().fx * camera.full().fy) ** 0.5])
        row[:15] = np.stack([down, right, -ahead, centre, lens], axis=1).ravel()
    with whole_file(path) as temporary, temporary.open("wb") as file:
        np.save(file, rows)


def _write(refined: RefinedSet, path: Path, context: WriteContext) -> None:
    source = None if context.dataset is None else context.dataset.source
    if context.bounds is not None:
        write_llff(refined, path, np.tile(context.bounds, (len(refined), 1)))
    elif source is not None and source.dialect == "llff":
        write_poses_bounds(refined, given_bounds(source.files[0], len(refined)), path)
    else:
        write_llff(refined, path)


CODECS = (
    Codec(LLFF, parse=parse_llff, write=_write, given_back=lambda dataset: dataset.source.dialect == "llff"),
)
