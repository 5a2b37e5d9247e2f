"""The poses of a file or folder alone: for comparing results, where the images need not lie beside them."""

from __future__ import annotations

import posixpath
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.formats.colmap.read_model import read_colmap_model, world_from_cam_of
from biresnerf.data.formats.read_dataset import find_input
from biresnerf.data.formats.simple.bundler import names_of_cameras, read_cameras
from biresnerf.data.formats.simple.llff import read_llff_poses
from biresnerf.data.formats.simple.metashape import read_metashape_poses
from biresnerf.data.formats.simple.trajectory import Trajectory, matched
from biresnerf.data.model.conventions import world_from_cam_of_file
from biresnerf.data.model.json_document import read_json_object
from biresnerf.data.model.pose_validation import rigid_matrix
from biresnerf.data.photos.named_images import photos_beside
from biresnerf.errors import InputError

Poses = dict[str, NDArray[np.float64]]
_MEND = "Give a transforms.json as nerfstudio, instant-ngp or Blender write it, or one written by `refine`."


def read_poses(path: Path) -> Poses:
    """``world_from_cam`` [4, 4] (OpenCV axes, in the world from before ``applied_transform``) by image name.

    Frames without a pose are left out. Names are as the file has them, with ``./`` and the like resolved. Poses that a
    file gives without names (LLFF, KITTI, TUM) are those of the images beside it, where they fit; else a trajectory's
    are called by their time or number.

    Args:
        path: a file in any form that `read_dataset` reads, or a folder that holds one.

    Raises:
        InputError: ``pose_file_invalid`` or another code of the form's reader; ``where`` starts with the path.
    """
    try:
        contents = find_input(path)
        file, form = contents.poses, contents.format
    except InputError as error:
        if error.code in ("input_missing", "input_unreadable"):
            raise _at(path, error, path.name) from None
        file, form = None, None
    if file is None or form is None:
        raise InputError("pose_file_invalid", "holds no poses that are read.", where=str(path), hint=_MEND)
    try:
        return _READERS[form](contents.root, file)
    except InputError as error:
        raise _at(file, error, file.name) from None


def _at(path: Path, error: InputError, name: str) -> InputError:
    # Two files are compared, often of one name: only the whole path says which.
    own = error.where.startswith((name, str(path)))
    where = str(path) + (error.where.removeprefix(str(path)).removeprefix(name) if own else f"/{error.where}")
    return InputError.of(error.fault, where=where)


def _colmap(_root: Path, folder: Path) -> Poses:
    images = read_colmap_model(folder).images.values()
    return {image.name: world_from_cam_of(image.cam_from_world) for image in images}


def _trajectory(root: Path, file: Path) -> Poses:
    trajectory = Trajectory(file)
    beside = sorted(photos_beside(root))
    if beside:
        try:
            return {
                name: trajectory.poses[index] for name, index in matched(trajectory, beside, root)[0].items()
            }
        except InputError:
            pass  # images of something else; the poses have names of their own
    return dict(zip(trajectory.names(), trajectory.poses, strict=True))


def _llff(root: Path, file: Path) -> Poses:
    poses, names = read_llff_poses(file), sorted(photos_beside(root))
    if len(names) != len(poses):
        names = [str(index) for index in range(len(poses))]
    return dict(zip(names, poses, strict=True))


def _bundler(root: Path, file: Path) -> Poses:
    entries = read_cameras(file)
    in_order = sorted(photos_beside(root))
    if len(in_order) != len(entries):
        in_order = [str(index) for index in range(len(entries))]
    names, _, _ = names_of_cameras(root, file, in_order, len(entries))
    return {name: pose for name, (_, pose) in zip(names, entries, strict=True) if pose is not None}


def _transforms(_root: Path, file: Path) -> Poses:
    document = read_json_object(file)
    applied, scale = np.eye(4), document.get("applied_scale", 1.0)
    if document.get("applied_transform") is not None:
        applied, _ = rigid_matrix(document["applied_transform"], f"{file.name} applied_transform")
    if isinstance(scale, bool) or not isinstance(scale, int | float) or scale <= 0:
        raise InputError(
            "pose_file_invalid", "is not a positive number.", where=f"{file.name} applied_scale", hint=_MEND
        )
    rows = document.get("frames")
    if not isinstance(rows, list):
        raise InputError(
            "pose_file_invalid", "has no list of frames.", where=f"{file.name} frames", hint=_MEND
        )
    poses: Poses = {}
    seen: set[str] = set()
    for index, row in enumerate(rows):
        where = f"{file.name} frames[{index}]"
        name = row.get("file_path") if isinstance(row, dict) else None
        if not isinstance(name, str) or not name:
            raise InputError("pose_file_invalid", "names no image.", where=f"{where}.file_path", hint=_MEND)
        name = posixpath.normpath(name)
        if name in seen:
            raise InputError(
                "duplicate_image", f"{name!r} stands twice.", where=f"{where}.file_path", hint="Remove one."
            )
        seen.add(name)
        if row.get("transform_matrix") is not None:
            matrix, _ = rigid_matrix(row["transform_matrix"], f"{where}.transform_matrix")
            poses[name] = world_from_cam_of_file(matrix, applied, float(scale))
    return poses


_READERS: dict[str, Callable[[Path, Path], Poses]] = {
    "transforms": _transforms,
    "colmap": _colmap,
    "llff": _llff,
    "bundler": _bundler,
    "metashape": lambda _root, file: read_metashape_poses(file),
    "trajectory": _trajectory,
}
