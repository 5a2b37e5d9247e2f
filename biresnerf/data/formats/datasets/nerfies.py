"""Nerfies' and HyperNeRF's ``camera/NAME.json`` for rgb/1x/NAME.png (or a smaller scale).

``orientation`` is the rotation cam_from_world, ``position`` the centre; OpenCV axes and coefficients, pixels from the
corner: nerfies/camera.py of google/nerfies. The world is the one that the file has, before scene.json's scale.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TypeAlias

import numpy as np
from pydantic import BaseModel, Field

from biresnerf.data.formats.codec import Codec, head_holds
from biresnerf.data.formats.parsed_poses import ParsedPoses
from biresnerf.data.formats.pose_rows import Placed, Row, lens_of, parsed_rows, shear_of, without_skew
from biresnerf.data.model.pose_validation import rigid_matrix
from biresnerf.data.model.untrusted_file import checked, read_json_object
from biresnerf.geometry.camera.camera_models import FullParameters
from biresnerf.options.formats import Format

NERFIES = Format(
    name="nerfies",
    title="Nerfies, HyperNeRF",
    rank=92,
    found_as=("camera",),
    gives="poses and lenses",
    checked_against="its source",
)
_HINT = "Give the camera/ that the capture was processed into."
_SCALES = ("rgb/1x", "rgb/2x", "rgb/4x", "rgb/8x", "rgb/16x", "rgb")
_Vector: TypeAlias = tuple[float, float, float]
_Pair: TypeAlias = tuple[float, float]


class _Camera(BaseModel, allow_inf_nan=False):
    orientation: tuple[_Vector, _Vector, _Vector]
    position: _Vector
    focal_length: float
    principal_point: _Pair
    image_size: tuple[int, int]
    skew: float = 0.0
    pixel_aspect_ratio: float = 1.0
    radial_distortion: _Vector = (0.0, 0.0, 0.0)
    # Its own to_json calls it tangential, published sets tangential_distortion; some have a third number, which is 0.
    tangential: list[float] | None = Field(default=None, min_length=2)
    tangential_distortion: list[float] = Field(default=[0.0, 0.0], min_length=2)


def parse_nerfies(_root: Path, place: Path) -> ParsedPoses:
    """The cameras in the folder ``place``, each for the photo of its name.

    Raises:
        InputError: codes as in docs/input.md.
    """
    files = sorted(place.glob("*.json"))
    rows: list[Row] = [(f"{file.stem}.png", file.name, partial(_read, file)) for file in files]
    return parsed_rows("nerfies", files, rows, take_file_names=True, photo_folders=_SCALES)


def _read(file: Path) -> Placed:
    camera = checked(_Camera, read_json_object(file), file.name, _HINT)
    rotation = np.array(camera.orientation).T
    pose = rigid_matrix(np.column_stack([rotation, camera.position]).tolist(), f"{file.name} orientation")[0]
    (k1, k2, k3), (p1, p2, *_) = camera.radial_distortion, camera.tangential or camera.tangential_distortion
    focal, (cx, cy) = camera.focal_length, camera.principal_point
    full = FullParameters(focal, focal * camera.pixel_aspect_ratio, cx, cy, k1=k1, k2=k2, k3=k3, p1=p1, p2=p2)
    shear = shear_of(camera.skew, full.fy, f"{file.name} skew")
    return pose, without_skew(lens_of(full, file.name, camera.image_size), shear, file.name)


def _recognises(place: Path) -> bool:
    first = next(iter(sorted(place.glob("*.json"))), None) if place.is_dir() else None
    return first is not None and head_holds(b'"orientation"')(first)


CODECS = (
    Codec(
        NERFIES,
        parse=parse_nerfies,
        recognises=_recognises,
        pose_place=lambda file: (
            file.parent if file.suffix == ".json" and file.parent.name == "camera" else None
        ),
        image_root=lambda place: place.parent,
    ),
)
