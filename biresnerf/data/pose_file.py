"""The poses of a transforms file alone: for comparing results, where the images need not lie beside the
file."""

from __future__ import annotations

import posixpath
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.conventions import world_from_cam_of_file
from biresnerf.data.json_document import read_json_object
from biresnerf.data.poses import rigid_matrix
from biresnerf.errors import InputError

_MEND = "Give a transforms.json as nerfstudio, instant-ngp or Blender write it, or one written by `refine`."


def read_poses(path: Path) -> dict[str, NDArray[np.float64]]:
    """``world_from_cam`` [4, 4] (OpenCV axes, in the world from before ``applied_transform``) by image name.

    Frames without a pose are left out. Names are as the file has them, with ``./`` and the like resolved.

    Args:
        path: a transforms file, or a folder that holds a transforms.json.

    Raises:
        InputError: ``pose_file_invalid`` or a code of `rigid_matrix`; ``where`` starts with the path.
    """
    file = path / "transforms.json" if path.is_dir() else path
    try:
        return _poses(file)
    except InputError as error:
        # Two files are compared, often of one name: only the whole path says which.
        where = str(file) + error.where.removeprefix(file.name)
        raise InputError(error.code, error.what, where=where, mend=error.mend) from None


def _poses(file: Path) -> dict[str, NDArray[np.float64]]:
    document = read_json_object(file)
    applied, scale = np.eye(4), document.get("applied_scale", 1.0)
    if document.get("applied_transform") is not None:
        applied, _ = rigid_matrix(document["applied_transform"], f"{file.name} applied_transform")
    if isinstance(scale, bool) or not isinstance(scale, int | float) or scale <= 0:
        raise InputError(
            "pose_file_invalid", "is not a positive number.", where=f"{file.name} applied_scale", mend=_MEND
        )
    rows = document.get("frames")
    if not isinstance(rows, list):
        raise InputError(
            "pose_file_invalid", "has no list of frames.", where=f"{file.name} frames", mend=_MEND
        )
    poses: dict[str, NDArray[np.float64]] = {}
    seen: set[str] = set()
    for index, row in enumerate(rows):
        where = f"{file.name} frames[{index}]"
        name = row.get("file_path") if isinstance(row, dict) else None
        if not isinstance(name, str) or not name:
            raise InputError("pose_file_invalid", "names no image.", where=f"{where}.file_path", mend=_MEND)
        name = posixpath.normpath(name)
        if name in seen:
            raise InputError(
                "duplicate_image", f"{name!r} stands twice.", where=f"{where}.file_path", mend="Remove one."
            )
        seen.add(name)
        if row.get("transform_matrix") is not None:
            matrix, _ = rigid_matrix(row["transform_matrix"], f"{where}.transform_matrix")
            poses[name] = world_from_cam_of_file(matrix, applied, float(scale))
    return poses
