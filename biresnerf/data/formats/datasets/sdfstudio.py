"""sdfstudio's ``meta_data.json``.

Camera to world, OpenCV axes, in the world that sdfstudio scaled to its box; a matrix of intrinsics an image. Pixels
count from the corner: data/dataparsers/sdfstudio_dataparser.py of nerfstudio (and of sdfstudio, which it is from).
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel

from biresnerf.data.formats.codec import Codec, head_holds
from biresnerf.data.formats.colmap.model_checks import listed_name
from biresnerf.data.formats.parsed_poses import ParsedPoses
from biresnerf.data.formats.pose_rows import Placed, Row, parsed_rows, pinhole_of
from biresnerf.data.model.pose_validation import rigid_matrix
from biresnerf.data.model.untrusted_file import checked, invalid_file, read_json_object
from biresnerf.options.formats import Format

SDFSTUDIO = Format(
    name="sdfstudio",
    title="sdfstudio meta_data.json",
    rank=89,
    found_as=("meta_data.json",),
    suffixes=(".json",),
    gives="poses and lenses",
    checked_against="its reader",
)
_HINT = "Give the meta_data.json that sdfstudio's scripts wrote."


class _Size(BaseModel):
    width: int
    height: int


class _Name(BaseModel):
    rgb_path: str


class _Frame(BaseModel, allow_inf_nan=False):
    camtoworld: list[list[float]]
    intrinsics: list[list[float]]


def parse_sdfstudio(_root: Path, file: Path) -> ParsedPoses:
    """The frames of ``file``.

    Raises:
        InputError: codes as in docs/input.md.
    """
    document = read_json_object(file)
    size, frames = checked(_Size, document, file.name, _HINT), document.get("frames")
    if not isinstance(frames, list):
        raise invalid_file(f"{file.name} frames", "is no list.", _HINT)

    def read(value: Any, where: str) -> Placed:
        frame = checked(_Frame, value, where, _HINT)
        if len(frame.intrinsics) < 3 or any(len(row) < 3 for row in frame.intrinsics):
            raise invalid_file(f"{where}.intrinsics", "is no matrix of 3 or 4 rows.", _HINT)
        matrix = np.array([row[:3] for row in frame.intrinsics[:3]])
        pose = rigid_matrix(frame.camtoworld, f"{where}.camtoworld")[0]
        return pose, pinhole_of(matrix, f"{where}.intrinsics", 0.5)(size.width, size.height)

    rows: list[Row] = []
    for index, value in enumerate(frames):
        where = f"{file.name} frames[{index}]"
        name = checked(_Name, value, where, _HINT).rgb_path
        rows.append((listed_name(name, f"{where}.rgb_path"), where, partial(read, value, where)))
    return parsed_rows("sdfstudio", [file], rows)


CODECS = (Codec(SDFSTUDIO, parse=parse_sdfstudio, recognises=head_holds(b'"camtoworld"')),)
