"""3D Scanner App's raw data: ``frame_NNNNN.json`` beside ``frame_NNNNN.jpg``, of ARKit.

``cameraPoseARFrame`` is camera to world by rows, OpenGL axes, y up; ``intrinsics`` is K by rows, for a size that
``projectionMatrix`` tells (its scales are twice the focal lengths through the width and height):
laanlabs/3dScannerApp_samples. There are more frames than photos. Pixels count from the corner, as in other captures of
ARKit.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import BaseModel, Field

from biresnerf.data.formats.codec import Codec, head_holds
from biresnerf.data.formats.parsed_poses import ParsedPoses
from biresnerf.data.formats.pose_rows import Placed, Row, lens_of, parsed_rows
from biresnerf.data.model.conventions import OPENCV_FROM_OPENGL
from biresnerf.data.model.pose_validation import rigid_matrix
from biresnerf.data.model.untrusted_file import checked, invalid_file, read_json_object
from biresnerf.data.photos.photo_folders import images_in
from biresnerf.geometry.camera.camera_models import FullParameters
from biresnerf.options.formats import Format

SCANNER_APP = Format(
    name="3d-scanner-app",
    title="3D Scanner App",
    rank=94,
    found_as=(".",),
    gives="poses and lenses of the frames that have a photo",
    checked_against="a real capture, laanlabs/3dScannerApp_samples",
    axes="opengl",
)
_HINT = "Export all data from the app again."
_FRAMES = "frame_*.json"


class _Frame(BaseModel, allow_inf_nan=False):
    pose: Annotated[list[float], Field(alias="cameraPoseARFrame", min_length=16, max_length=16)]
    intrinsics: Annotated[list[float], Field(min_length=9, max_length=9)]
    projection: Annotated[list[float], Field(alias="projectionMatrix", min_length=16, max_length=16)]


def parse_scanner_app(_root: Path, place: Path) -> ParsedPoses:
    """The frames in ``place`` that have a photo.

    Raises:
        InputError: codes as in docs/input.md.
    """
    photos = {path.stem: path.name for path in images_in(place)}
    files = [file for file in sorted(place.glob(_FRAMES)) if file.stem in photos or not photos]
    rows: list[Row] = [(photos.get(file.stem, file.stem), file.name, partial(_read, file)) for file in files]
    return parsed_rows("3d-scanner-app", files, rows)


def _read(file: Path) -> Placed:
    frame = checked(_Frame, read_json_object(file), file.name, _HINT)
    fx, _, cx, _, fy, cy, *_ = frame.intrinsics
    across, down = frame.projection[0], frame.projection[5]
    if not (across > 0.0 and down > 0.0):
        raise invalid_file(f"{file.name} projectionMatrix", "is none of a camera.", _HINT)
    size = (round(2 * fx / across), round(2 * fy / down))
    rows = np.reshape(frame.pose, (4, 4)).tolist()
    pose = rigid_matrix(rows, f"{file.name} cameraPoseARFrame")[0] @ OPENCV_FROM_OPENGL
    return np.asarray(pose), lens_of(FullParameters(fx, fy, cx, cy), file.name, size)


def _recognises(place: Path) -> bool:
    first = next(iter(sorted(place.glob(_FRAMES))), None) if place.is_dir() else None
    return first is not None and head_holds(b'"cameraPoseARFrame"')(first)


CODECS = (
    Codec(
        SCANNER_APP,
        parse=parse_scanner_app,
        recognises=_recognises,
        pose_place=lambda file: file.parent if file.match(_FRAMES) else None,
        image_root=lambda place: place,
    ),
)
