"""The cameras.json that 3D Gaussian Splatting writes into the folder of a trained model.

Layout: utils/camera_utils.py of graphdeco-inria/gaussian-splatting, camera_to_JSON: camera to world, OpenCV axes, the
principal point in the image's centre.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from biresnerf.data.formats.bind_images import ParsedPoses, PoseEntry
from biresnerf.data.formats.codec import Codec, head_holds
from biresnerf.data.formats.colmap.model_checks import camera_of_numbers, image_name
from biresnerf.data.model.dataset import SourceFormat
from biresnerf.data.model.pose_validation import rigid_matrix
from biresnerf.data.model.text_file import invalid_file, read_text
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
_HINT = "Give the cameras.json that 3DGS wrote."
_KEYS = ("img_name", "width", "height", "position", "rotation", "fx", "fy")


def parse_gaussian_splatting(_root: Path, file: Path) -> ParsedPoses:
    """The cameras of ``file``, each for the image of its name, with or without extension.

    Raises:
        InputError: codes as in docs/input.md.
    """
    try:
        rows = json.loads(read_text(file))
    except (ValueError, RecursionError) as error:
        raise invalid_file(file.name, f"is not JSON: {error}.", _HINT) from None
    if not isinstance(rows, list):
        raise invalid_file(file.name, "is not a list of cameras.", _HINT)
    entries = tuple(_entry(row, f"{file.name} [{index}]") for index, row in enumerate(rows))
    if len({entry.name for entry in entries}) != len(entries):
        raise InputError("duplicate_image", "names an image twice.", where=file.name, hint="Remove one.")
    source = SourceFormat("gaussian-splatting", files=(file,))
    return ParsedPoses(source, entries)


def _entry(row: Any, where: str) -> PoseEntry:
    lacking = [key for key in _KEYS if not isinstance(row, dict) or key not in row]
    if lacking:
        raise invalid_file(where, f"has no {', '.join(lacking)}.", _HINT)
    name = image_name(str(row["img_name"]), f"{where}.img_name")
    centre = np.asarray(_numbers(row["position"], 3, f"{where}.position"))
    rotation = [_numbers(line, 3, f"{where}.rotation") for line in _listed(row["rotation"], 3, where)]
    pose, _ = rigid_matrix(np.column_stack([rotation, centre]).tolist(), where)
    width, height, fx, fy = _numbers([row[key] for key in ("width", "height", "fx", "fy")], 4, where)
    params = (fx, fy, width / 2, height / 2)
    return PoseEntry(
        name, pose, where, camera_of_numbers("PINHOLE", round(width), round(height), params, where)
    )


def _listed(value: Any, count: int, where: str) -> list[Any]:
    if not isinstance(value, list) or len(value) != count:
        raise invalid_file(where, f"is not a list of {count}.", _HINT)
    return value


def _numbers(value: Any, count: int, where: str) -> list[float]:
    values = _listed(value, count, where)
    if any(isinstance(one, bool) or not isinstance(one, int | float) for one in values):
        raise invalid_file(where, "holds something other than numbers.", _HINT)
    if not all(abs(one) < 1e300 and math.isfinite(one) for one in values):
        raise InputError(
            "pose_not_finite", "NaN or an infinite number.", where=where, hint="Remove the camera."
        )
    return [float(one) for one in values]


CODECS = (Codec(GAUSSIAN_SPLATTING, parse=parse_gaussian_splatting, recognises=head_holds(b'"img_name"')),)
