"""Checks of a COLMAP model, table by table and as a whole, binary or text."""

from __future__ import annotations

import posixpath
from collections import Counter
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.model import colmap_scene as colmap
from biresnerf.data.model.pose_validation import MAX_COORDINATE, MAX_POINT_COORDINATE
from biresnerf.data.model.untrusted_file import refuse_not_finite
from biresnerf.errors import InputError
from biresnerf.geometry.camera.camera_models import (
    COLMAP_MODELS,
    MODEL_IDS,
    MODEL_PARAMETERS,
    PANORAMA,
    Camera,
)
from biresnerf.geometry.camera.lens import lens_problem

MAX_SIDE_PX = 10**6
MAX_FEATURE_PX = 1e7
# COLMAP writes unit quaternions with 15 digits, others with 6; a length beyond this is no rounding.
QUAT_LENGTH_ERROR = 1e-2
_HINT = "Export the model again with COLMAP, or copy it again: it may be cut off."
_UNDISTORT = "Undistort the images with COLMAP's image_undistorter."


def broken(where: str, what: str, code: str = "pose_file_invalid", hint: str = _HINT) -> InputError:
    """The error for a model of which ``what`` is wrong at ``where``."""
    return InputError(code, f"{what}.", where=where, hint=hint)


def unsupported(where: str, what: str, hint: str) -> InputError:
    """The error for a lens or camera model, at ``where``, that is not read."""
    return InputError("camera_model_unsupported", what, where=where, hint=hint)


def sensor_type(kind: int, where: str) -> colmap.SensorType:
    """The sensor's type by COLMAP's number."""
    if not 0 <= kind < len(colmap.SENSOR_TYPES):
        raise broken(where, f"{kind} is no type of sensor")
    return colmap.SENSOR_TYPES[kind]


def rig_of_sensors(
    number: int, sensors: Sequence[tuple[colmap.Sensor, colmap.RigidPose | None]], where: str
) -> colmap.ColmapRig:
    """The rig of these sensors with ``sensor_from_rig``; the first is the reference. Each may be listed once."""
    names = [sensor for sensor, _ in sensors]
    for (kind, sensor_id), count in Counter(names).items():
        if count > 1:
            raise broken(where, f"the sensor {kind} {sensor_id} is listed twice")
    return colmap.ColmapRig(number, names[0] if names else None, dict(sensors[1:]))


def model_name_of_id(model_id: int, where: str) -> str:
    """The camera model's name. Raises InputError ``camera_model_unsupported``."""
    known = 0 <= model_id < len(COLMAP_MODELS)
    return supported_model(COLMAP_MODELS[model_id] if known else f"number {model_id}", where)


def supported_model(name: str, where: str) -> str:
    """``name`` itself. Raises InputError ``camera_model_unsupported``."""
    if name not in MODEL_IDS:
        hint = f"Supported are {', '.join(MODEL_IDS)}. {_UNDISTORT}"
        if name == PANORAMA:
            hint = (
                "Give the panoramas alone, and their poses are found; or give the poses in a transforms.json with "
                f'"camera_model": "{PANORAMA}".'
            )
        raise unsupported(where, f"the camera model {name[:40]} is not supported.", hint)
    return name


def camera_of_numbers(model: str, width: int, height: int, params: Sequence[float], where: str) -> Camera:
    """The camera, if there can be such a one. Raises InputError ``intrinsics_invalid``."""

    def invalid(what: str) -> InputError:
        return broken(
            where, what, "intrinsics_invalid", "Give the intrinsics that the images were taken with."
        )

    if not (0 < width <= MAX_SIDE_PX and 0 < height <= MAX_SIDE_PX):
        raise invalid(f"{width} x {height} px is no image size")
    if len(params) != len(MODEL_PARAMETERS[model]):
        raise invalid(f"{model} takes {len(MODEL_PARAMETERS[model])} parameters, not {len(params)}")
    if not np.isfinite(params).all():
        raise invalid("a parameter is no finite number")
    camera = Camera(model, int(width), int(height), tuple(float(value) for value in params))
    try:
        full, side = camera.full(), max(width, height)
    except ValueError as error:
        raise broken(where, str(error), "camera_model_unsupported", _UNDISTORT) from None
    if not all(1e-3 * side < focal < 1e5 * side for focal in (full.fx, full.fy)):
        raise invalid(f"{full.fx:g}, {full.fy:g} px is no focal length")
    if not (-width < full.cx < 2 * width and -height < full.cy < 2 * height):
        raise invalid(f"the principal point ({full.cx:g}, {full.cy:g}) lies far outside the image")
    problem = lens_problem(full, width, height)
    if problem is not None:
        raise invalid(problem.removesuffix("."))
    return camera


def image_name(raw: bytes | str, where: str) -> str:
    """A name that stays inside the folder of images. Raises InputError ``unsafe_path`` where it does not."""
    try:
        name = raw.decode() if isinstance(raw, bytes) else raw
    except UnicodeDecodeError:
        raise broken(where, "the image's name is not UTF-8", hint="Rename the image.") from None
    if not name or any(ord(letter) < 32 or ord(letter) == 127 for letter in name):
        raise broken(where, "the image's name is empty or has control characters", hint="Rename the image.")
    for spelling in (name, name.replace("\\", "/")):
        drive = spelling[1:3] == ":/"
        if drive or spelling.startswith("/") or ".." in posixpath.normpath(spelling).split("/"):
            raise InputError(
                "unsafe_path",
                f"{name[:100]!r} leads out of the folder of images.",
                where=where,
                hint="Name images by their path relative to the folder of images.",
            )
    return name


def check_features(xy: NDArray[np.float64], where: str) -> None:
    """Raises InputError unless the positions [n, 2] of features are finite and near their image."""
    if not np.isfinite(xy).all():
        raise broken(where, "a feature's position is no finite number", "pose_not_finite")
    if len(xy) and np.abs(xy).max() > MAX_FEATURE_PX:
        what = f"a feature is farther than {MAX_FEATURE_PX:g} px from the image"
        raise broken(where, what, "pose_out_of_range", "Remove the image's features.")


def listed_name(raw: str, where: str) -> str:
    """A name as a list of another machine may have it: of an absolute path, what follows the root or the drive.

    It is looked for among the files of the set only (`match_names.match_files`), never opened as a path.

    Raises:
        InputError: as `image_name` does.
    """
    name = raw.strip().replace("\\", "/")
    if name[1:2] == ":":
        name = name[2:]
    return image_name(name.lstrip("/").removeprefix("./"), where)


def rigid_pose(numbers: Sequence[float], where: str, hint: str = _HINT) -> colmap.RigidPose:
    """The pose of a quaternion (w, x, y, z) and a translation. Raises InputError unless it is rigid and finite."""
    values = np.array(numbers, dtype=np.float64)
    refuse_not_finite(values, where, "Remove the image.")
    length = float(np.linalg.norm(np.clip(values[:4], -9.0, 9.0)))  # a square overflows
    if abs(length - 1.0) > QUAT_LENGTH_ERROR:
        raise broken(where, f"the quaternion has length {length:.3g}, not 1", "pose_not_rotation", hint)
    if np.abs(values[4:]).max() > MAX_COORDINATE:
        raise broken(
            where,
            f"the position is farther than {MAX_COORDINATE:g} from the origin",
            "pose_out_of_range",
            "Move the scene's origin near the scene.",
        )
    return colmap.RigidPose(values[:4], values[4:])


def points_of_records(
    ids: NDArray[np.int64],
    xyz: NDArray[np.float64],
    rgb: NDArray[np.uint8],
    errors: NDArray[np.float64],
    lengths: NDArray[np.int64],
    elements: NDArray[np.int64],
    file: str,
) -> colmap.ColmapPoints:
    """The points of parsed columns; ``elements`` [k, 2] has image ids and features of all tracks in a row."""
    if len(np.unique(ids)) != len(ids) or (ids < 0).any():
        raise broken(file, "two points have the same id, or an id is out of range")
    if not (np.isfinite(xyz).all() and np.isfinite(errors).all()):
        raise broken(file, "a point's position or error is no finite number", "pose_not_finite")
    if len(xyz) and max(np.abs(xyz).max(), np.abs(errors).max()) > MAX_POINT_COORDINATE:
        what = f"a point's position or error is larger than {MAX_POINT_COORDINATE:g}"
        raise broken(file, what, "pose_out_of_range", "Remove the point.")
    starts = np.concatenate([np.zeros(1, np.int64), np.cumsum(lengths)])
    return colmap.ColmapPoints(ids, xyz, rgb, errors, starts, elements[:, 0].copy(), elements[:, 1].copy())


def check_images(images: dict[int, colmap.ColmapImage], cameras: dict[int, Camera], file: str) -> None:
    """Raises InputError for images without camera and repeated names."""
    names: dict[str, int] = {}
    for image in images.values():
        where = f"{file} image {image.id}"
        if image.camera_id not in cameras:
            raise broken(where, f"there is no camera {image.camera_id}")
        first = names.setdefault(image.name, image.id)
        if first != image.id:
            raise broken(
                where, f"{image.name!r} is also image {first}", "duplicate_image", "Remove one of the two."
            )


def check_tracks(images: dict[int, colmap.ColmapImage], points: colmap.ColmapPoints, file: str) -> None:
    """Raises InputError where an image's features and the points' tracks contradict each other."""
    observed = 0
    for image in images.values():
        if (image.point3d_ids < colmap.NO_POINT).any():
            raise broken(f"{file} image {image.id}", "a point's id is out of range")
        observed += int((image.point3d_ids != colmap.NO_POINT).sum())
    seen_by = np.repeat(points.ids, np.diff(points.track_starts))
    order = np.argsort(points.track_image_ids, kind="stable")
    image_ids, firsts = np.unique(points.track_image_ids[order], return_index=True)
    for image_id, elements in zip(image_ids.tolist(), np.split(order, firsts[1:]), strict=False):
        if image_id not in images:
            raise broken(file, f"a point's track names image {image_id}, which is not there")
        features, ids = points.track_point2d_indices[elements], images[image_id].point3d_ids
        if (features >= len(ids)).any() or not np.array_equal(ids[features], seen_by[elements]):
            raise broken(file, f"a point's track and the features of image {image_id} contradict each other")
    if observed != len(points.track_image_ids):
        raise broken(file, "features name points that are not there, or whose tracks do not name them")


def check_rigs(
    rigs: dict[int, colmap.ColmapRig],
    frames: dict[int, colmap.ColmapFrame],
    cameras: dict[int, Camera],
    images: dict[int, colmap.ColmapImage],
    file: str,
) -> None:
    """Raises InputError for rigs, frames and images that do not fit together."""
    for rig in rigs.values():
        for kind, number in [*([rig.reference] if rig.reference else []), *rig.sensor_from_rig]:
            if kind == "CAMERA" and number not in cameras:
                raise broken(f"{file} rig {rig.id}", f"there is no camera {number}")
    placed: dict[int, int] = {}
    for frame in frames.values():
        where = f"{file} frame {frame.id}"
        if frame.rig_id not in rigs:
            raise broken(where, f"there is no rig {frame.rig_id}")
        rig = rigs[frame.rig_id]
        for sensor, data_id in frame.data_ids:
            if sensor != rig.reference and sensor not in rig.sensor_from_rig:
                raise broken(where, f"its rig has no sensor {sensor[0]} {sensor[1]}")
            if sensor[0] != "CAMERA":
                continue
            if data_id not in images or images[data_id].camera_id != sensor[1]:
                raise broken(where, f"there is no image {data_id} of camera {sensor[1]}")
            if placed.setdefault(data_id, frame.id) != frame.id:
                raise broken(where, f"image {data_id} is also in frame {placed[data_id]}")
    alone = [image.id for image in images.values() if image.id not in placed]
    if alone:
        raise broken(file, f"image {alone[0]} is in no frame")
