"""One camera for all images, given in a file beside a trajectory: camera.json, cameras.txt or KITTI's calib.txt."""

from __future__ import annotations

from pathlib import Path

from biresnerf.data.formats.bind_images import FrameCamera, LensOf
from biresnerf.data.formats.colmap import read_text as colmap_text
from biresnerf.data.formats.colmap.model_checks import broken, camera_of_numbers
from biresnerf.data.formats.transforms.read_intrinsics import Fields, camera_of_frame
from biresnerf.data.model.untrusted_file import read_json_object, read_text
from biresnerf.data.photos.image_files import ImageHeader
from biresnerf.errors import InputError
from biresnerf.geometry.camera.camera_models import Camera

CAMERA_NAMES = ("camera.json", "cameras.txt", "calib.txt")


def read_camera_file(root: Path) -> tuple[Camera | LensOf | None, tuple[Path, ...]]:
    """The lens of the images, by their header, and the files that were read; None where there is no such file.

    camera.json has the keys of a transforms.json's top (``w``, ``h``, ``fl_x``, ``k1``, ...), cameras.txt is COLMAP's
    with one camera, calib.txt is KITTI's (its P0 belongs to the poses).

    Raises:
        InputError: the first of `CAMERA_NAMES` that is there does not hold one camera.
    """
    present = [root / name for name in CAMERA_NAMES if (root / name).is_file()]
    if not present:
        return None, ()
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

        return of_json, (file,)
    if file.name == "cameras.txt":
        cameras = list(colmap_text.parse_cameras(read_text(file), file.name).values())
        if len(cameras) != 1:
            raise broken(file.name, f"has {len(cameras)} cameras, and does not say which image is by which")
        return cameras[0], (file,)
    params = _kitti_projection(file)

    def of_calibration(header: ImageHeader, _name: str) -> FrameCamera:
        camera = camera_of_numbers("PINHOLE", header.width, header.height, params, f"{file.name} P0")
        return FrameCamera(camera)

    return of_calibration, (file,)


def _kitti_projection(file: Path) -> tuple[float, float, float, float]:
    """fx, fy, cx, cy (px) of the line ``P0: `` and 12 numbers, by rows."""
    for line in read_text(file).splitlines():
        name, _, rest = line.partition(":")
        if name.strip() != "P0":
            continue
        values = colmap_text.floats(rest.split(), f"{file.name} P0", "the projection")
        if len(values) != 12:
            raise broken(f"{file.name} P0", f"has {len(values)} numbers, not 12")
        return float(values[0]), float(values[5]), float(values[2]), float(values[6])
    raise broken(
        file.name, "has no line P0:", hint="Give KITTI's calib.txt, or a camera.json with fl_x, fl_y, cx, cy."
    )
