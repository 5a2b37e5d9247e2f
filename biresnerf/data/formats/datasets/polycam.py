"""Polycam's raw capture: a JSON per photo in keyframes/corrected_cameras (or cameras), of ARKit.

``t_00`` to ``t_23`` are camera to world by rows with OpenGL axes, in ARKit's world (y up): nerfstudio's
process_data/polycam_utils.py, which exchanges the world's axes; here they stay. Coordinates of pixels count from the
corner there. Photos are in corrected_images (images) under the same names; newer files leave their size out.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
from pydantic import BaseModel

from biresnerf.data.formats.codec import Codec, head_holds
from biresnerf.data.formats.parsed_poses import ParsedPoses
from biresnerf.data.formats.pose_rows import Placed, Row, at_size_of, lens_of, parsed_rows
from biresnerf.data.model.conventions import OPENCV_FROM_OPENGL
from biresnerf.data.model.pose_validation import rigid_matrix
from biresnerf.data.model.untrusted_file import checked, invalid_file, read_json_object
from biresnerf.geometry.camera.camera_models import FullParameters
from biresnerf.options.formats import Format

POLYCAM = Format(
    name="polycam",
    title="Polycam raw data",
    rank=85,
    found_as=("keyframes/corrected_cameras", "corrected_cameras", "keyframes/cameras", "cameras"),
    gives="poses and lenses, those that Polycam corrected where it has them",
    checked_against="nerfstudio's reader",
    axes="opengl",
)
_HINT = "Export the raw data from Polycam again."
_PHOTOS = {"corrected_cameras": "corrected_images", "cameras": "images"}


class _Camera(BaseModel, allow_inf_nan=False):
    fx: float
    fy: float
    cx: float
    cy: float
    width: int = 0
    height: int = 0


class _Matrix(BaseModel, allow_inf_nan=False):
    rows: list[list[float]]


def parse_polycam(root: Path, place: Path) -> ParsedPoses:
    """The keyframes in the folder ``place``.

    Raises:
        InputError: codes as in docs/input.md.
    """
    files = sorted(place.glob("*.json"))
    rows: list[Row] = [(f"{file.stem}.jpg", file.name, partial(_read, file)) for file in files]
    beside = place.parent / _PHOTOS[place.name]
    folder = beside.relative_to(root).as_posix() if beside.is_relative_to(root) else beside.name
    return parsed_rows("polycam", files, rows, take_file_names=True, photo_folders=(folder,))


def _read(file: Path) -> Placed:
    document = read_json_object(file)
    camera = checked(_Camera, document, file.name, _HINT)
    keys = [[f"t_{row}{column}" for column in range(4)] for row in range(3)]
    missing = [key for row in keys for key in row if key not in document]
    if missing:
        raise invalid_file(file.name, f"has no {missing[0]}.", _HINT)
    matrix = checked(_Matrix, {"rows": [[document[key] for key in row] for row in keys]}, file.name, _HINT)
    pose = rigid_matrix(matrix.rows, f"{file.name} t_00")[0] @ OPENCV_FROM_OPENGL
    full = FullParameters(camera.fx, camera.fy, camera.cx, camera.cy)
    sized = camera.width and camera.height
    lens = lens_of(full, file.name, (camera.width, camera.height)) if sized else None
    return np.asarray(pose), lens or at_size_of(lambda *size: lens_of(full, file.name, size))


def _recognises(place: Path) -> bool:
    first = next(iter(sorted(place.glob("*.json"))), None) if place.is_dir() else None
    return first is not None and head_holds(b'"t_00"')(first)


CODECS = (
    Codec(
        POLYCAM,
        parse=parse_polycam,
        recognises=_recognises,
        pose_place=lambda file: (
            file.parent if file.suffix == ".json" and file.parent.name in _PHOTOS else None
        ),
        image_root=lambda place: place.parent,
    ),
)
