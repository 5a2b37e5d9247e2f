"""BOP's ``scene_camera.json``: the lens of each image, and its pose where the scene has a world.

docs/bop_datasets_format.md of thodan/bop_toolkit: cam_R_w2c by rows and cam_t_w2c (mm), OpenCV axes; images are
rgb/000000.png (or gray/). A pixel's coordinates are its indices: depth_im_to_dist_im in bop_toolkit_lib/misc.py.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from pydantic import BaseModel

from biresnerf.data.formats.codec import Codec, head_holds
from biresnerf.data.formats.parsed_poses import ParsedPoses
from biresnerf.data.formats.pose_rows import Placed, Row, at_size_of, parsed_rows, pinhole_of
from biresnerf.data.model.pose_validation import rigid_matrix
from biresnerf.data.model.untrusted_file import checked, invalid_file, read_json_object
from biresnerf.geometry.rigid import rigid_inverse
from biresnerf.options.formats import Format

BOP = Format(
    name="bop",
    title="BOP scene_camera.json",
    rank=87,
    found_as=("scene_camera.json",),
    suffixes=(".json",),
    gives="lenses, and poses (mm) where it has cam_R_w2c",
    checked_against="its description; Feo-cat/TransparentObjectPose, patricksko/PoseEstimator",
    cam_from_world=True,
)
_HINT = "Give the scene_camera.json of the scene."
_Nine: TypeAlias = tuple[float, float, float, float, float, float, float, float, float]


class _Camera(BaseModel, allow_inf_nan=False):
    cam_K: _Nine  # noqa: N815
    cam_R_w2c: _Nine | None = None  # noqa: N815
    cam_t_w2c: tuple[float, float, float] | None = None


def parse_bop(_root: Path, file: Path) -> ParsedPoses:
    """The cameras of a scene, each for the image of its number.

    Raises:
        InputError: codes as in docs/input.md.
    """

    def read(value: Any, where: str) -> Placed:
        camera = checked(_Camera, value, where, _HINT)
        lens = at_size_of(pinhole_of(np.array(camera.cam_K).reshape(3, 3), f"{where}.cam_K", 0.0))
        if camera.cam_R_w2c is None or camera.cam_t_w2c is None:
            return None, lens
        matrix = np.column_stack([np.array(camera.cam_R_w2c).reshape(3, 3), camera.cam_t_w2c])
        return rigid_inverse(rigid_matrix(matrix.tolist(), where)[0]), lens

    rows: list[Row] = []
    for number, value in read_json_object(file).items():
        where = f"{file.name} {number}"
        if not number.isdecimal():
            raise invalid_file(where, "is not the number of an image.", _HINT)
        rows.append((f"{int(number):06}.png", where, partial(read, value, where)))
    return parsed_rows("bop", [file], rows, take_file_names=True, photo_folders=("rgb", "gray"))


CODECS = (Codec(BOP, parse=parse_bop, recognises=head_holds(b'"cam_K"')),)
