"""One camera for all images, given in a file beside a trajectory: camera.json, cameras.txt or KITTI's calib.txt."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.formats.colmap.model_checks import broken, camera_of_numbers
from biresnerf.data.formats.colmap.read_tables import TextTable, floats, read_cameras
from biresnerf.data.formats.parsed_poses import FrameCamera, LensOf
from biresnerf.data.formats.transforms.read_intrinsics import Fields, camera_of_frame
from biresnerf.data.model.untrusted_file import read_json_object, read_text
from biresnerf.data.photos.image_files import ImageHeader
from biresnerf.data.photos.photo_folders import images_below
from biresnerf.errors import InputError
from biresnerf.geometry.camera.camera_models import Camera

CAMERA_NAMES = ("camera.json", "cameras.txt", "calib.txt")


_IMAGE_OF_KITTI = re.compile(r"image_0?([0-3])$")
CameraFile: TypeAlias = tuple[Camera | LensOf | None, NDArray[np.float64], tuple[Path, ...]]


def read_camera_file(root: Path, photo_folders: Sequence[str] = ()) -> CameraFile:
    """The lens of the images, by their header; ``cam_from_pose`` [4, 4]; and the files that were read.

    The lens is None where there is no such file. ``cam_from_pose`` mounts the camera on the body that has the poses.

    camera.json has the keys of a transforms.json's top (``w``, ``h``, ``fl_x``, ``k1``, ...), cameras.txt is COLMAP's
    with one camera, calib.txt is KITTI's: of the camera that the folder of the photos (image_2/) is called after,
    else P0. The poses are those of camera 0; the projection's last column says where the others are mounted.

    Raises:
        InputError: the first of `CAMERA_NAMES` that is there does not hold one camera.
    """
    present = [root / name for name in CAMERA_NAMES if (root / name).is_file()]
    if not present:
        return None, np.eye(4), ()
    file = present[0]
    if file.suffix == ".json":
        document = read_json_object(file)

        def of_json(header: ImageHeader, name: str) -> FrameCamera:
            found = camera_of_frame(Fields({}, document, file.name, 0), header, name)
            if found.source != "given":
                raise InputError(
                    "intrinsics_missing",
                    "no focal length: neither fl_x nor camera_angle_x.",
                    where=file.name,
                    hint="Add fl_x (pixels), or remove the file: a focal length is then guessed and refined.",
                )
            return found

        return of_json, np.eye(4), (file,)
    if file.name == "cameras.txt":
        cameras = list(read_cameras(TextTable(read_text(file), file.name)).values())
        if len(cameras) != 1:
            raise broken(file.name, f"has {len(cameras)} cameras, and does not say which image is by which")
        return cameras[0], np.eye(4), (file,)
    name, projection = _kitti_projection(file, root, photo_folders)
    params = (projection[0, 0], projection[1, 1], projection[0, 2], projection[1, 2])

    def of_calibration(header: ImageHeader, _name: str) -> FrameCamera:
        camera = camera_of_numbers("PINHOLE", header.width, header.height, params, f"{file.name} {name}")
        return FrameCamera(camera)

    cam_from_pose = np.eye(4)
    if np.isfinite(projection).all() and np.linalg.matrix_rank(projection[:, :3]) == 3:
        cam_from_pose[:3, 3] = np.linalg.solve(projection[:, :3], projection[:, 3])
    return of_calibration, cam_from_pose, (file,)


def _kitti_projection(
    file: Path, root: Path, photo_folders: Sequence[str]
) -> tuple[str, NDArray[np.float64]]:
    """The projection [3, 4] of the photos' camera and its name: the line ``P2: `` and 12 numbers, by rows, or P0."""
    rows = {}
    for line in read_text(file).splitlines():
        name, _, rest = line.partition(":")
        rows[name.strip()] = rest
    used = next((name for name in photo_folders if images_below(root / name)), "")
    match = _IMAGE_OF_KITTI.match(used)
    for name in ([f"P{match[1]}"] if match else []) + ["P0"]:
        if name not in rows:
            continue
        where = f"{file.name} {name}"
        values = floats(rows[name].split(), where, "the projection")
        if len(values) != 12:
            raise broken(where, f"has {len(values)} numbers, not 12")
        return name, np.array(values, dtype=np.float64).reshape(3, 4)
    raise broken(
        file.name, "has no line P0:", hint="Give KITTI's calib.txt, or a camera.json with fl_x, fl_y, cx, cy."
    )
