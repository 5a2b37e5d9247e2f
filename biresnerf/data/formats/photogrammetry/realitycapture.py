"""RealityCapture's csv of internal and external camera parameters.

The program's source is closed: columns and conventions are those by which nerfstudio reads the file
(process_data/realitycapture_utils.py, 1.1.5). Heading (clockwise), pitch and roll are degrees: world_from_cam with
OpenGL axes is Rz(-heading) Rx(pitch) Ry(roll). The focal length is that of a film 36 mm wide; px and py are shares of
the longer side, from the centre; t1 and t2 are OpenCV's p1 and p2.
"""

from __future__ import annotations

import csv
import io
import math
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.formats.codec import Codec
from biresnerf.data.formats.photogrammetry.lens_limits import refuse_other_lenses
from biresnerf.data.model.atomic_file import write_text
from biresnerf.data.model.refined_set import RefinedSet
from biresnerf.errors import InputError
from biresnerf.options.formats import Format

REALITYCAPTURE = Format(
    name="realitycapture",
    title="RealityCapture csv",
    rank=65,
    in_set="realitycapture.csv",
    loses=("rigs", "points", "mask paths"),
    instead="pinhole",
    lacks="folders of photos; fisheyes; two focal lengths; FULL_OPENCV beyond k3",
    heading="For RealityCapture",
    hint="Internal/External camera parameters, by the photos' file names",
)
COLUMNS = (
    "#name", "x", "y", "alt", "heading", "pitch", "roll", "f", "px", "py", "k1", "k2", "k3", "k4", "t1", "t2",
)  # fmt: skip
_FILM_MM = 36.0
_OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0])


def write_realitycapture(refined: RefinedSet, path: Path) -> None:
    """Writes the file, whole or not at all; a line an image, in the set's order.

    Raises:
        InputError: ``export_not_possible``: a lens that the file cannot hold, or two photos of one file name.
    """
    refuse_other_lenses(refined, "RealityCapture", path.name, fisheye=False, two_focal_lengths=False)
    names = [PurePosixPath(image.file_name).name for image in refined.images]
    if len(set(names)) < len(names):
        raise InputError(
            "export_not_possible",
            "RealityCapture's csv names photos by their file names, which two photos of this set share.",
            where=path.name,
            hint="Export `pinhole`, whose photos have names of their own, and convert that.",
        )
    file = io.StringIO()
    table = csv.writer(file, lineterminator="\n")
    table.writerow(COLUMNS)
    for index, (name, pose) in enumerate(zip(names, refined.world_from_cam, strict=True)):
        camera = refined.camera_of(index)
        full, size = camera.full(), max(camera.width, camera.height)
        heading, pitch, roll = _angles_deg(pose[:3, :3] @ _OPENGL_FROM_OPENCV)
        centre = ((full.cx - camera.width / 2) / size, (full.cy - camera.height / 2) / size)
        lens = (full.fx * _FILM_MM / size, *centre, full.k1, full.k2, full.k3, 0.0, full.p1, full.p2)
        table.writerow([name, *pose[:3, 3].tolist(), heading, pitch, roll, *lens])
    write_text(path, file.getvalue().rstrip("\n"))


def _angles_deg(rotation: NDArray[np.float64]) -> tuple[float, float, float]:
    """Heading, pitch and roll of ``rotation`` = Rz(-heading) Rx(pitch) Ry(roll), degrees; roll is 0 at the poles."""
    sine = float(np.clip(rotation[2, 1], -1.0, 1.0))
    across = math.hypot(rotation[2, 0], rotation[2, 2])
    pitch = math.atan2(sine, across)
    if across > 1e-9:
        yaw, roll = (
            math.atan2(-rotation[0, 1], rotation[1, 1]),
            math.atan2(-rotation[2, 0], rotation[2, 2]),
        )
    else:
        yaw, roll = math.atan2(rotation[1, 0], rotation[0, 0]), 0.0
    return math.degrees(-yaw), math.degrees(pitch), math.degrees(roll)


CODECS = (Codec(REALITYCAPTURE, write=lambda refined, path, _: write_realitycapture(refined, path)),)
