"""Record3D's capture: ``metadata.json`` (``metadata`` in an unpacked .r3d) beside rgb/ or rgbd/.

A pose is a quaternion, scalar last, and the position, camera to world with OpenGL axes; K is by columns; photos are
called by their number from 0: nerfstudio's process_data/record3d_utils.py, which takes coordinates of pixels from the
corner. ``perFrameIntrinsicCoeffs`` has fx, fy, cx and cy of each frame, as autofocus moves the lens.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from pydantic import BaseModel

from biresnerf.data.formats.codec import Codec, head_holds
from biresnerf.data.formats.colmap.model_checks import rigid_pose
from biresnerf.data.formats.parsed_poses import ParsedPoses
from biresnerf.data.formats.pose_rows import Placed, Row, parsed_rows, pinhole_of
from biresnerf.data.model.colmap_scene import matrix_of_pose
from biresnerf.data.model.conventions import OPENCV_FROM_OPENGL
from biresnerf.data.model.untrusted_file import checked, invalid_file, read_json_object
from biresnerf.options.formats import Format

RECORD3D = Format(
    name="record3d",
    title="Record3D",
    rank=84,
    found_as=("metadata.json", "metadata"),
    suffixes=(".json",),
    gives="poses; lenses, one an image where the app kept them",
    checked_against="nerfstudio's reader; YaroslavGladun/door_handle_detection",
    axes="opengl",
    quaternion="xyzw",
)
_HINT = "Export the capture from Record3D again (RGBD frames and metadata)."
_Coefficients: TypeAlias = tuple[float, float, float, float]


class _Metadata(BaseModel, allow_inf_nan=False):
    w: int
    h: int
    K: tuple[float, float, float, float, float, float, float, float, float]


class _Frame(BaseModel, allow_inf_nan=False):
    pose: tuple[float, float, float, float, float, float, float]
    lens: _Coefficients | None = None


def parse_record3d(_root: Path, file: Path) -> ParsedPoses:
    """The frames of a capture, each for the photo of its number.

    Raises:
        InputError: codes as in docs/input.md.
    """
    document = read_json_object(file)
    metadata = checked(_Metadata, document, file.name, _HINT)
    poses, lenses = document.get("poses"), document.get("perFrameIntrinsicCoeffs") or []
    if not isinstance(poses, list) or not isinstance(lenses, list) or (lenses and len(lenses) != len(poses)):
        raise invalid_file(f"{file.name} poses", "is no list of a pose, and a lens, for each frame.", _HINT)
    shared = np.array(metadata.K).reshape(3, 3).T

    def read(number: int, where: str) -> Placed:
        values: dict[str, Any] = {"pose": poses[number], "lens": lenses[number] if lenses else None}
        frame = checked(_Frame, values, where, _HINT)
        x, y, z, w, *position = frame.pose
        pose = matrix_of_pose(rigid_pose((w, x, y, z, *position), where, _HINT)) @ OPENCV_FROM_OPENGL
        matrix = shared
        if frame.lens is not None:
            fx, fy, cx, cy = frame.lens
            matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        return pose, pinhole_of(matrix, where, 0.5)(metadata.w, metadata.h)

    places = [f"{file.name} poses[{number}]" for number in range(len(poses))]
    rows: list[Row] = [(f"{i}.jpg", where, partial(read, i, where)) for i, where in enumerate(places)]
    return parsed_rows("record3d", [file], rows, take_file_names=True, photo_folders=("rgb", "rgbd"))


def _recognises(file: Path) -> bool:
    """Whether one of its keys is in the head: lists of thousands of frames stand between them, in any order."""
    return any(
        head_holds(key)(file) for key in (b'"poses"', b'"initPose"', b'"frameTimestamps"', b'"perFrameIntr')
    )


CODECS = (Codec(RECORD3D, parse=parse_record3d, recognises=_recognises),)
