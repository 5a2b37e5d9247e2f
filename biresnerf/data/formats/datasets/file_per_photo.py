"""Captures with a file for each photo, which has its pose and lens: MVSNet, Nerfies, Polycam, 3D Scanner App.

MVSNet's ``cams/NAME_cam.txt`` holds an extrinsic matrix, then an intrinsic one; depths at the end are not used:
load_cam in mvsnet/preprocess.py of YoYo000/MVSNet. The first pixel's middle is (0.5, 0.5): get_pixel_grids in
mvsnet/homography_warping.py.

Nerfies' and HyperNeRF's ``camera/NAME.json`` is for rgb/1x/NAME.png (or a smaller scale). ``orientation`` is the
rotation cam_from_world, ``position`` the centre; OpenCV coefficients, pixels from the corner: nerfies/camera.py of
google/nerfies. The world is the one that the file has, before scene.json's scale.

Polycam's raw capture, of ARKit, has ``t_00`` to ``t_23``, camera to world by rows, in ARKit's world (y up):
nerfstudio's process_data/polycam_utils.py, which exchanges the world's axes; here they stay. Coordinates of pixels
count from the corner there. Photos are in corrected_images (images) under the same names; newer files leave their size
out.

3D Scanner App's raw data, of ARKit too, are ``frame_NNNNN.json`` beside ``frame_NNNNN.jpg``. ``cameraPoseARFrame`` is
camera to world by rows, y up; ``intrinsics`` is K by rows, for a size that ``projectionMatrix`` tells (its scales are
twice the focal lengths through the width and height): laanlabs/3dScannerApp_samples. There are more frames than photos.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Annotated, TypeAlias

import numpy as np
from pydantic import BaseModel, Field

from biresnerf.data.formats.codec import Codec, head_holds
from biresnerf.data.formats.parsed_poses import ParsedPoses
from biresnerf.data.formats.pose_rows import (
    Placed,
    at_size_of,
    lens_of,
    parsed_rows,
    pinhole_of,
    pose_by,
    shear_of,
    without_skew,
)
from biresnerf.data.model.untrusted_file import (
    checked,
    finite_numbers,
    invalid_file,
    read_json_object,
    read_text,
)
from biresnerf.data.photos.photo_folders import images_in
from biresnerf.geometry.camera.camera_models import FullParameters
from biresnerf.options.formats import Format

MVSNET = Format(
    name="mvsnet",
    title="MVSNet cameras",
    rank=86,
    found_as=("cams",),
    gives="poses, one lens an image",
    checked_against="its source; LiangliangNan/RealCameraViewer",
    cam_from_world=True,
)
NERFIES = Format(
    name="nerfies",
    title="Nerfies, HyperNeRF",
    rank=92,
    found_as=("camera",),
    gives="poses and lenses",
    checked_against="its source",
)
POLYCAM = Format(
    name="polycam",
    title="Polycam raw data",
    rank=85,
    found_as=("keyframes/corrected_cameras", "corrected_cameras", "keyframes/cameras", "cameras"),
    gives="those that Polycam corrected, where it has them",
    checked_against="nerfstudio's reader",
    axes="opengl",
)
SCANNER_APP = Format(
    name="3d-scanner-app",
    title="3D Scanner App",
    rank=94,
    found_as=(".",),
    gives="poses and lenses of the frames that have a photo",
    checked_against="a real capture, laanlabs/3dScannerApp_samples",
    axes="opengl",
)
_Vector: TypeAlias = tuple[float, float, float]
_Pair: TypeAlias = tuple[float, float]


def _codec(
    form: Format,
    files: tuple[str, ...],
    marker: bytes,
    read: Callable[[Path, str], Placed],
    photos: Callable[[str], tuple[str, ...]] = lambda folder: (),
    extension: str = ".jpg",
) -> Codec:
    """The codec of such a format.

    Args:
        files: patterns of the ends of their paths.
        marker: what the first file's head holds.
        read: gives pose and lens of a file, and takes its name for messages.
        photos: the folders of the photos beside that of the files, which is called so; the preferred one first.
        extension: of the photos, as a rule.
    """
    pattern, suffix = Path(files[0]).name, Path(files[0]).name.removeprefix("*")

    def parse(root: Path, place: Path) -> ParsedPoses:
        paths = sorted(place.glob(pattern))
        rows = [(f"{path.name.removesuffix(suffix)}{extension}", path.name, path) for path in paths]
        folders = [place.parent / name for name in photos(place.name)]
        below = [
            one.relative_to(root).as_posix() if one.is_relative_to(root) else one.name for one in folders
        ]
        return parsed_rows(form, paths, rows, read, take_file_names=True, photo_folders=below)

    def recognises(place: Path) -> bool:
        first = next(iter(sorted(place.glob(pattern))), None) if place.is_dir() else None
        return first is not None and head_holds(marker)(first)

    return Codec(
        form,
        parse=parse,
        recognises=recognises,
        pose_place=lambda file: file.parent if any(map(file.match, files)) else None,
        image_root=lambda place: place if form.found_as == (".",) else place.parent,
    )


def _read_mvsnet(file: Path, where: str) -> Placed:
    hint = "Give an extrinsic matrix of 4 rows and an intrinsic one of 3, each below its name."
    words = read_text(file).split()
    if len(words) < 27 or (words[0], words[17]) != ("extrinsic", "intrinsic"):
        raise invalid_file(where, "does not hold an extrinsic and an intrinsic matrix.", hint)
    extrinsic = finite_numbers(words[1:17], f"{where} extrinsic", hint).reshape(4, 4)
    intrinsic = finite_numbers(words[18:27], f"{where} intrinsic", hint).reshape(3, 3)
    lens = at_size_of(pinhole_of(intrinsic, f"{where} intrinsic", 0.5))
    return pose_by(MVSNET, extrinsic, f"{where} extrinsic"), lens


class _NerfiesCamera(BaseModel, allow_inf_nan=False):
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


def _read_nerfies(file: Path, where: str) -> Placed:
    hint = "Give the camera/ that the capture was processed into."
    camera = checked(_NerfiesCamera, read_json_object(file), where, hint)
    matrix = np.column_stack([np.array(camera.orientation).T, camera.position])
    (k1, k2, k3), (p1, p2, *_) = camera.radial_distortion, camera.tangential or camera.tangential_distortion
    focal, (cx, cy) = camera.focal_length, camera.principal_point
    full = FullParameters(focal, focal * camera.pixel_aspect_ratio, cx, cy, k1=k1, k2=k2, k3=k3, p1=p1, p2=p2)
    shear = shear_of(camera.skew, full.fy, f"{where} skew")
    lens = without_skew(lens_of(full, where, camera.image_size), shear, where)
    return pose_by(NERFIES, matrix, f"{where} orientation"), lens


class _PolycamCamera(BaseModel, allow_inf_nan=False):
    fx: float
    fy: float
    cx: float
    cy: float
    width: int = 0
    height: int = 0


class _PolycamMatrix(BaseModel, allow_inf_nan=False):
    rows: list[list[float]]


def _read_polycam(file: Path, where: str) -> Placed:
    hint = "Export the raw data from Polycam again."
    document = read_json_object(file)
    camera = checked(_PolycamCamera, document, where, hint)
    keys = [[f"t_{row}{column}" for column in range(4)] for row in range(3)]
    missing = [key for row in keys for key in row if key not in document]
    if missing:
        raise invalid_file(where, f"has no {missing[0]}.", hint)
    matrix = checked(_PolycamMatrix, {"rows": [[document[key] for key in row] for row in keys]}, where, hint)
    full = FullParameters(camera.fx, camera.fy, camera.cx, camera.cy)
    sized = camera.width and camera.height
    lens = lens_of(full, where, (camera.width, camera.height)) if sized else None
    return pose_by(POLYCAM, matrix.rows, f"{where} t_00"), lens or at_size_of(
        lambda *size: lens_of(full, where, size)
    )


class _ScannerFrame(BaseModel, allow_inf_nan=False):
    pose: Annotated[list[float], Field(alias="cameraPoseARFrame", min_length=16, max_length=16)]
    intrinsics: Annotated[list[float], Field(min_length=9, max_length=9)]
    projection: Annotated[list[float], Field(alias="projectionMatrix", min_length=16, max_length=16)]


def _parse_scanner_app(_root: Path, place: Path) -> ParsedPoses:
    """The frames in ``place`` that have a photo."""
    photos = {path.stem: path.name for path in images_in(place)}
    files = [file for file in sorted(place.glob("frame_*.json")) if file.stem in photos or not photos]
    rows = [(photos.get(file.stem, file.stem), file.name, file) for file in files]
    return parsed_rows(SCANNER_APP, files, rows, _read_scanner_app)


def _read_scanner_app(file: Path, where: str) -> Placed:
    hint = "Export all data from the app again."
    frame = checked(_ScannerFrame, read_json_object(file), where, hint)
    fx, _, cx, _, fy, cy, *_ = frame.intrinsics
    across, down = frame.projection[0], frame.projection[5]
    if not (across > 0.0 and down > 0.0):
        raise invalid_file(f"{where} projectionMatrix", "is none of a camera.", hint)
    lens = lens_of(FullParameters(fx, fy, cx, cy), where, (round(2 * fx / across), round(2 * fy / down)))
    return pose_by(SCANNER_APP, np.reshape(frame.pose, (4, 4)), f"{where} cameraPoseARFrame"), lens


CODECS = (
    _codec(MVSNET, ("*_cam.txt",), b"extrinsic", _read_mvsnet, lambda _: ("images", "blended_images")),
    _codec(
        NERFIES,
        ("camera/*.json",),
        b'"orientation"',
        _read_nerfies,
        lambda _: ("rgb/1x", "rgb/2x", "rgb/4x", "rgb/8x", "rgb/16x", "rgb"),
        ".png",
    ),
    _codec(
        POLYCAM,
        ("corrected_cameras/*.json", "cameras/*.json"),
        b'"t_00"',
        _read_polycam,
        lambda folder: (folder.replace("cameras", "images"),),
    ),
    replace(
        _codec(SCANNER_APP, ("frame_*.json",), b'"cameraPoseARFrame"', _read_scanner_app),
        parse=_parse_scanner_app,
    ),
)
