"""JSON files that list the cameras of a set: BOP, Record3D, sdfstudio, and 3D Gaussian Splatting's cameras.json.

BOP's ``scene_camera.json`` has the lens of each image, and its pose where the scene has a world:
docs/bop_datasets_format.md of thodan/bop_toolkit: cam_R_w2c by rows and cam_t_w2c (mm); images are rgb/000000.png (or
gray/). A pixel's coordinates are its indices: depth_im_to_dist_im in bop_toolkit_lib/misc.py.

Record3D's ``metadata.json`` (``metadata`` in an unpacked .r3d) lies beside rgb/ or rgbd/. A pose is a quaternion and
the position; K is by columns; photos are called by their number from 0: nerfstudio's process_data/record3d_utils.py,
which takes coordinates of pixels from the corner. ``perFrameIntrinsicCoeffs`` has fx, fy, cx and cy of each frame, as
autofocus moves the lens.

sdfstudio's ``meta_data.json`` has poses in the world that sdfstudio scaled to its box, and a matrix of intrinsics an
image. Pixels count from the corner: data/dataparsers/sdfstudio_dataparser.py of nerfstudio (and of sdfstudio, which it
is from).

3DGS writes ``cameras.json`` into the folder of a trained model. Layout: utils/camera_utils.py of
graphdeco-inria/gaussian-splatting, camera_to_JSON; the principal point is in the image's centre.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from pydantic import BaseModel

from biresnerf.data.formats.codec import Codec, head_holds
from biresnerf.data.formats.colmap.model_checks import camera_of_numbers
from biresnerf.data.formats.parsed_poses import ParsedPoses
from biresnerf.data.formats.pose_rows import (
    Placed,
    Row,
    at_size_of,
    named_rows,
    parsed_rows,
    pinhole_of,
    pose_by,
    pose_of_numbers,
)
from biresnerf.data.model.untrusted_file import checked, invalid_file, read_json, read_json_object
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
RECORD3D = Format(
    name="record3d",
    title="Record3D",
    rank=84,
    found_as=("metadata.json", "metadata"),
    suffixes=(".json",),
    gives="poses; lenses, one an image where the app kept them",
    checked_against="nerfstudio's reader; YaroslavGladun/door_handle_detection",
    axes="opengl",
    quaternion="xyzw",
)
SDFSTUDIO = Format(
    name="sdfstudio",
    title="sdfstudio meta_data.json",
    rank=89,
    found_as=("meta_data.json",),
    suffixes=(".json",),
    gives="poses and lenses",
    checked_against="its reader",
)
GAUSSIAN_SPLATTING = Format(
    name="gaussian-splatting",
    title="3DGS cameras.json",
    rank=75,
    found_as=("cameras.json",),
    suffixes=(".json",),
    gives="poses, two focal lengths an image",
    checked_against="its source; a real file",
)
_BOP_HINT = "Give the scene_camera.json of the scene."
_RECORD3D_HINT = "Export the capture from Record3D again (RGBD frames and metadata)."
_SDFSTUDIO_HINT = "Give the meta_data.json that sdfstudio's scripts wrote."
_3DGS_HINT = "Give the cameras.json that 3DGS wrote."
_Vector: TypeAlias = tuple[float, float, float]
_Nine: TypeAlias = tuple[float, float, float, float, float, float, float, float, float]


class _BopCamera(BaseModel, allow_inf_nan=False):
    cam_K: _Nine  # noqa: N815
    cam_R_w2c: _Nine | None = None  # noqa: N815
    cam_t_w2c: _Vector | None = None


def parse_bop(_root: Path, file: Path) -> ParsedPoses:
    """The cameras of a scene, each for the image of its number."""
    rows: list[Row] = []
    for number, value in read_json_object(file).items():
        where = f"{file.name} {number}"
        if not number.isdecimal():
            raise invalid_file(where, "is not the number of an image.", _BOP_HINT)
        rows.append((f"{int(number):06}.png", where, value))
    return parsed_rows(BOP, [file], rows, _read_bop, take_file_names=True, photo_folders=("rgb", "gray"))


def _read_bop(value: Any, where: str) -> Placed:
    camera = checked(_BopCamera, value, where, _BOP_HINT)
    lens = at_size_of(pinhole_of(np.array(camera.cam_K).reshape(3, 3), f"{where}.cam_K", 0.0))
    if camera.cam_R_w2c is None or camera.cam_t_w2c is None:
        return None, lens
    matrix = np.column_stack([np.array(camera.cam_R_w2c).reshape(3, 3), camera.cam_t_w2c])
    return pose_by(BOP, matrix, where), lens


class _Metadata(BaseModel, allow_inf_nan=False):
    w: int
    h: int
    K: _Nine


class _Record(BaseModel, allow_inf_nan=False):
    pose: tuple[float, float, float, float, float, float, float]
    lens: tuple[float, float, float, float] | None = None


def parse_record3d(_root: Path, file: Path) -> ParsedPoses:
    """The frames of a capture, each for the photo of its number.

    Raises:
        InputError: codes as in docs/input.md.
    """
    document = read_json_object(file)
    metadata = checked(_Metadata, document, file.name, _RECORD3D_HINT)
    poses, lenses = document.get("poses"), document.get("perFrameIntrinsicCoeffs") or []
    if not isinstance(poses, list) or not isinstance(lenses, list) or (lenses and len(lenses) != len(poses)):
        what = "is no list of a pose, and a lens, for each frame."
        raise invalid_file(f"{file.name} poses", what, _RECORD3D_HINT)

    def read(number: int, where: str) -> Placed:
        values: dict[str, Any] = {"pose": poses[number], "lens": lenses[number] if lenses else None}
        frame = checked(_Record, values, where, _RECORD3D_HINT)
        matrix = np.array(metadata.K).reshape(3, 3).T
        if frame.lens is not None:
            fx, fy, cx, cy = frame.lens
            matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        pose = pose_of_numbers(RECORD3D, frame.pose[:4], frame.pose[4:], where, _RECORD3D_HINT)
        return pose, pinhole_of(matrix, where, 0.5)(metadata.w, metadata.h)

    rows = [(f"{number}.jpg", f"{file.name} poses[{number}]", number) for number in range(len(poses))]
    return parsed_rows(RECORD3D, [file], rows, read, take_file_names=True, photo_folders=("rgb", "rgbd"))


class _Size(BaseModel):
    width: int
    height: int


class _SdfFrame(BaseModel, allow_inf_nan=False):
    camtoworld: list[list[float]]
    intrinsics: list[list[float]]


def parse_sdfstudio(_root: Path, file: Path) -> ParsedPoses:
    """The frames of ``file``.

    Raises:
        InputError: codes as in docs/input.md.
    """
    document = read_json_object(file)
    size, frames = checked(_Size, document, file.name, _SDFSTUDIO_HINT), document.get("frames")
    if not isinstance(frames, list):
        raise invalid_file(f"{file.name} frames", "is no list.", _SDFSTUDIO_HINT)

    def read(value: Any, where: str) -> Placed:
        frame = checked(_SdfFrame, value, where, _SDFSTUDIO_HINT)
        if len(frame.intrinsics) < 3 or any(len(row) < 3 for row in frame.intrinsics):
            raise invalid_file(f"{where}.intrinsics", "is no matrix of 3 or 4 rows.", _SDFSTUDIO_HINT)
        matrix = np.array([row[:3] for row in frame.intrinsics[:3]])
        lens = pinhole_of(matrix, f"{where}.intrinsics", 0.5)(size.width, size.height)
        return pose_by(SDFSTUDIO, frame.camtoworld, f"{where}.camtoworld"), lens

    rows = named_rows(frames, f"{file.name} frames", "rgb_path", _SDFSTUDIO_HINT)
    return parsed_rows(SDFSTUDIO, [file], rows, read)


class _SplattingCamera(BaseModel, allow_inf_nan=False):
    """A camera as the file has it; further keys are left alone."""

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
    document = read_json(file)
    if not isinstance(document, list):
        raise invalid_file(file.name, "is no list of cameras.", _3DGS_HINT)
    rows = named_rows(document, f"{file.name} ", "img_name", _3DGS_HINT)
    return parsed_rows(GAUSSIAN_SPLATTING, [file], rows, _read_splatting)


def _read_splatting(value: Any, where: str) -> Placed:
    row = checked(_SplattingCamera, value, where, _3DGS_HINT)
    params = (row.fx, row.fy, row.width / 2, row.height / 2)
    lens = camera_of_numbers("PINHOLE", round(row.width), round(row.height), params, where)
    return pose_by(GAUSSIAN_SPLATTING, np.column_stack([row.rotation, row.position]), where), lens


CODECS = (
    Codec(BOP, parse=parse_bop, recognises=head_holds(b'"cam_K"')),
    Codec(
        RECORD3D,
        parse=parse_record3d,
        # Lists of thousands of frames stand between its keys, in any order.
        recognises=head_holds(b'"poses"', b'"initPose"', b'"frameTimestamps"', b'"perFrameIntr'),
    ),
    Codec(SDFSTUDIO, parse=parse_sdfstudio, recognises=head_holds(b'"camtoworld"')),
    Codec(GAUSSIAN_SPLATTING, parse=parse_gaussian_splatting, recognises=head_holds(b'"img_name"')),
)
