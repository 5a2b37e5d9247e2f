"""The cameras.json that 3D Gaussian Splatting writes into the folder of a trained model.

Layout: utils/camera_utils.py of graphdeco-inria/gaussian-splatting, camera_to_JSON: camera to world, OpenCV axes, the
principal point in the image's centre.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pydantic import BaseModel, TypeAdapter, ValidationError

from biresnerf.data.formats.codec import Codec, head_holds
from biresnerf.data.formats.colmap.model_checks import camera_of_numbers, image_name
from biresnerf.data.formats.parsed_poses import ParsedPoses, PoseEntry
from biresnerf.data.model.dataset import SourceFormat
from biresnerf.data.model.pose_validation import rigid_matrix
from biresnerf.data.model.untrusted_file import first_problem, read_text
from biresnerf.errors import InputError
from biresnerf.options.formats import Format

GAUSSIAN_SPLATTING = Format(
    name="gaussian-splatting",
    title="3DGS cameras.json",
    rank=75,
    found_as=("cameras.json",),
    suffixes=(".json",),
    gives="poses, two focal lengths an image",
    checked_against="files written from its source; one real file",
)
_Vector = tuple[float, float, float]


class _Row(BaseModel, strict=True, allow_inf_nan=False):
    """A camera as the file has it; further keys are left alone."""

    img_name: str
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
    try:
        rows = TypeAdapter(list[_Row]).validate_json(read_text(file))
    except ValidationError as error:
        finite = error.errors()[0]["type"] != "finite_number"
        code = "pose_file_invalid" if finite else "pose_not_finite"
        raise first_problem(error, file, code=code, hint="Give the cameras.json that 3DGS wrote.") from None
    entries = tuple(_entry(row, f"{file.name} [{index}]") for index, row in enumerate(rows))
    if len({entry.name for entry in entries}) != len(entries):
        raise InputError("duplicate_image", "names an image twice.", where=file.name, hint="Remove one.")
    return ParsedPoses(SourceFormat("gaussian-splatting", files=(file,)), entries)


def _entry(row: _Row, where: str) -> PoseEntry:
    name = image_name(row.img_name, f"{where}.img_name")
    pose, _ = rigid_matrix(np.column_stack([row.rotation, row.position]).tolist(), where)
    params = (row.fx, row.fy, row.width / 2, row.height / 2)
    lens = camera_of_numbers("PINHOLE", round(row.width), round(row.height), params, where)
    return PoseEntry(name, pose, where, lens)


CODECS = (Codec(GAUSSIAN_SPLATTING, parse=parse_gaussian_splatting, recognises=head_holds(b'"img_name"')),)
