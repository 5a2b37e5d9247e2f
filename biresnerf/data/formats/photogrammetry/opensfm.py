"""``reconstruction.json`` of OpenSfM and OpenDroneMap: lenses, poses and points.

Layout and conventions: opensfm/io.py (camera_to_json, shot_to_json, point_to_json) and opensfm/features.py
(normalized_image_coordinates) of mapillary/OpenSfM. A rotation is the axis times the angle of cam_from_world, OpenCV
axes. Lengths in the picture are shares of its longer side, from its centre, where a picture's corner lies half a
pixel from the first pixel's middle, as here. p1 and p2 are OpenCV's.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.formats.codec import Codec
from biresnerf.data.formats.photogrammetry.lens_limits import BROWN, FISHEYE, refuse_other_lenses
from biresnerf.data.model.atomic_file import write_json
from biresnerf.data.model.conventions import quat_wxyz_from_rotation
from biresnerf.data.model.refined_set import RefinedSet
from biresnerf.data.photos.photo_folders import IMAGE_FOLDER
from biresnerf.geometry.camera.camera_models import Camera
from biresnerf.options.formats import Format

OPENSFM = Format(
    name="opensfm",
    title="reconstruction.json (OpenSfM)",
    rank=62,
    in_set="reconstruction.json",
    loses=("rigs", "mask paths"),
    instead="pinhole",
    lacks="FULL_OPENCV beyond k3",
    heading="For OpenSfM, OpenDroneMap",
    hint="Put it into the folder of the project; photos are in its images/",
)


def write_opensfm(refined: RefinedSet, path: Path) -> None:
    """Writes the file, whole or not at all: one reconstruction.

    Photos are named by their path in images/, where OpenSfM has them.

    Raises:
        InputError: ``export_not_possible``: a lens that OpenSfM does not have.
    """
    refuse_other_lenses(refined, "OpenSfM", path.name, fisheye=True, two_focal_lengths=True)
    shots = {}
    for image, pose in zip(refined.images, refined.cam_from_world, strict=True):
        shots[image.file_name.removeprefix(f"{IMAGE_FOLDER}/")] = {
            "rotation": rotation_vector(pose[:3, :3]).tolist(),
            "translation": pose[:3, 3].tolist(),
            "camera": str(image.camera),
            "orientation": 1,
        }
    points = refined.model.points
    write_json(
        path,
        [
            {
                "cameras": {str(index): _lens(camera) for index, camera in enumerate(refined.cameras)},
                "shots": shots,
                "points": {
                    str(number): {"coordinates": xyz, "color": rgb}
                    for number, xyz, rgb in zip(
                        points.ids.tolist(), points.xyz.tolist(), points.rgb.tolist(), strict=True
                    )
                },
            }
        ],
    )


def rotation_vector(rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    """The axis times the angle (radians, at most pi) of a rotation [3, 3]."""
    w, *axis = quat_wxyz_from_rotation(rotation).tolist()
    sine = math.sqrt(sum(value * value for value in axis))
    angle = 2.0 * math.atan2(sine, w)
    return np.array(axis) * (angle / sine if sine > 0.0 else 2.0)


def _lens(camera: Camera) -> dict[str, Any]:
    full, size = camera.full(), max(camera.width, camera.height)
    return {
        "projection_type": "fisheye_opencv" if full.fisheye else "brown",
        "width": camera.width,
        "height": camera.height,
        "focal_x": full.fx / size,
        "focal_y": full.fy / size,
        "c_x": (full.cx - camera.width / 2) / size,
        "c_y": (full.cy - camera.height / 2) / size,
        **{name: getattr(full, name) for name in (FISHEYE if full.fisheye else BROWN)},
    }


CODECS = (Codec(OPENSFM, write=lambda refined, path, _: write_opensfm(refined, path)),)
