"""The cameras.json that 3D Gaussian Splatting writes into the folder of a trained model.

Layout: utils/camera_utils.py of graphdeco-inria/gaussian-splatting, camera_to_JSON: camera to world, OpenCV axes, the
principal point in the image's centre.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel

from biresnerf.data.formats.codec import Codec, head_holds
from biresnerf.data.formats.colmap.model_checks import camera_of_numbers, image_name
from biresnerf.data.formats.parsed_poses import ParsedPoses
from biresnerf.data.formats.pose_rows import Placed, Row, parsed_rows
from biresnerf.data.model.pose_validation import rigid_matrix
from biresnerf.data.model.untrusted_file import checked, invalid_file, read_json
from biresnerf.options.formats import Format

GAUSSIAN_SPLATTING = Format(
    name="gaussian-splatting",
    title="3DGS cameras.json",
    rank=75,
    found_as=("cameras.json",),
    suffixes=(".json",),
    gives="poses, two focal lengths an image",
    checked_against="its source; a real file",
)
_Vector = tuple[float, float, float]


_HINT = "Give the cameras.json that 3DGS wrote."


class _Name(BaseModel):
    img_name: str


class _Row(BaseModel, allow_inf_nan=False):
    """A camera as the file has it; further keys are left alone."""

    width: float
    height: float
    position: _Vector
    rotation: tuple[_Vector, _Vector, _Vector]
    fx: float
    fy: float


def parse_gaussian_splatting(_root: Path, file: Path) -> ParsedPoses:
    """The cameras of ``file``, each for the image of its name, with or without extension.

    Raises:
        InputError: codes as in docs/input.md.
    """
    document = read_json(file)
    if not isinstance(document, list):
        raise invalid_file(file.name, "is no list of cameras.", _HINT)
    rows: list[Row] = []
    for index, value in enumerate(document):
        where = f"{file.name} [{index}]"
        name = checked(_Name, value, where, _HINT).img_name
        rows.append((image_name(name, f"{where}.img_name"), where, partial(_read, value, where)))
    return parsed_rows("gaussian-splatting", [file], rows)


def _read(value: Any, where: str) -> Placed:
    row = checked(_Row, value, where, _HINT)
    pose, _ = rigid_matrix(np.column_stack([row.rotation, row.position]).tolist(), where)
    params = (row.fx, row.fy, row.width / 2, row.height / 2)
    return pose, camera_of_numbers("PINHOLE", round(row.width), round(row.height), params, where)


CODECS = (Codec(GAUSSIAN_SPLATTING, parse=parse_gaussian_splatting, recognises=head_holds(b'"img_name"')),)
