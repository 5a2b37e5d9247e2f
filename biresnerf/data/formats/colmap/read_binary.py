"""COLMAP's binary tables, parsed field by field; nothing is allocated before the file is known to hold it.

Layouts: src/colmap/scene/reconstruction_io_binary.cc; little-endian throughout. `model_checks` compares the tables
with each other.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np

from biresnerf.data.formats.colmap import model_checks as checks
from biresnerf.data.model import colmap_scene as colmap
from biresnerf.geometry.camera.camera_models import MODEL_PARAMETERS, Camera

Row = TypeVar("Row")
_U64, _U32, _U8 = struct.Struct("<Q"), struct.Struct("<I"), struct.Struct("<B")
_CAMERA = struct.Struct("<IiQQ")
_IMAGE = struct.Struct("<I7dI")
_SENSOR = struct.Struct("<iI")
_POSE = struct.Struct("<7d")
_RIG = struct.Struct("<II")
_FRAME = struct.Struct("<II7dI")
_DATA_ID = struct.Struct("<iIQ")
_POINT = struct.Struct("<Q3d3BdQ")
_POINT_2D = np.dtype([("xy", "<f8", 2), ("id", "<u8")])
_POINT_3D = np.dtype(
    [("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("length", "<u8")]
)
_MAX_NAME_BYTES = 4096


class _Bytes:
    """A file's content and how far it was read."""

    def __init__(self, data: bytes, file: str) -> None:
        self.data, self.file, self.at = data, file, 0

    @property
    def left(self) -> int:
        return len(self.data) - self.at

    def take(self, form: struct.Struct, what: str) -> tuple[Any, ...]:
        """The values of ``form``, which are ``what``."""
        if self.left < form.size:
            raise checks.broken(self.file, f"ends in the middle of {what}, at byte {len(self.data)}")
        values = form.unpack_from(self.data, self.at)
        self.at += form.size
        return values

    def count(self, form: struct.Struct, least_bytes: int, what: str) -> int:
        """A number of things that take ``least_bytes`` each at least, checked against what is left."""
        at = self.at
        (number,) = self.take(form, f"the number of {what}")
        if number * least_bytes > self.left:
            raise checks.broken(
                self.file, f"names {number} {what} at byte {at}, but only {self.left} bytes follow"
            )
        return int(number)

    def array(self, dtype: np.dtype[Any], number: int) -> np.ndarray:
        """``number`` records that `count` has checked."""
        values = np.frombuffer(self.data, dtype, number, self.at)
        self.at += number * dtype.itemsize
        return values

    def name(self, what: str) -> bytes:
        """The bytes up to the next NUL."""
        end = self.data.find(b"\0", self.at, self.at + _MAX_NAME_BYTES)
        if end < 0:
            raise checks.broken(self.file, f"the name of {what} has no end")
        name = self.data[self.at : end]
        self.at = end + 1
        return name

    def finish(self) -> None:
        """Refuses bytes after the last record."""
        if self.left:
            raise checks.broken(self.file, f"{self.left} bytes follow the last record")


def _table(
    data: bytes, file: str, kind: str, least_bytes: int, parse: Callable[[_Bytes, str], tuple[int, Row]]
) -> dict[int, Row]:
    """The rows by id; ``parse`` reads one from its first byte, given its name for messages."""
    source = _Bytes(data, file)
    table: dict[int, Row] = {}
    for index in range(source.count(_U64, least_bytes, f"{kind}s")):
        number, row = parse(source, f"{kind} {index + 1}")
        checks.refuse_repeated(table, number, f"{file} {kind}")
        table[number] = row
    source.finish()
    return table


def parse_cameras(data: bytes, file: str) -> dict[int, Camera]:
    """The cameras by id."""

    def camera(source: _Bytes, what: str) -> tuple[int, Camera]:
        number, model_id, width, height = source.take(_CAMERA, what)
        where = f"{file} camera {number}"
        model = checks.model_name_of_id(model_id, where)
        form = struct.Struct(f"<{len(MODEL_PARAMETERS[model])}d")
        params = source.take(form, f"the parameters of camera {number}")
        return number, checks.camera_of_numbers(model, width, height, params, where)

    return _table(data, file, "camera", _CAMERA.size, camera)


def parse_images(data: bytes, file: str) -> dict[int, colmap.ColmapImage]:
    """The registered images by id."""

    def image(source: _Bytes, what: str) -> tuple[int, colmap.ColmapImage]:
        number, *pose, camera_id = source.take(_IMAGE, what)
        where = f"{file} image {number}"
        name = checks.image_name(source.name(f"image {number}"), where)
        points = source.array(_POINT_2D, source.count(_U64, _POINT_2D.itemsize, f"points of image {number}"))
        checks.check_features(points["xy"], where)
        ids = points["id"].astype(np.int64)  # COLMAP's mark of no point, 2^64 - 1, becomes NO_POINT
        xy = points["xy"].astype(np.float64)
        return number, colmap.ColmapImage(number, name, camera_id, checks.rigid_pose(pose, where), xy, ids)

    return _table(data, file, "image", _IMAGE.size + 1 + _U64.size, image)


def parse_points(data: bytes, file: str) -> colmap.ColmapPoints:
    """The 3D points in the file's order."""
    source = _Bytes(data, file)
    number = source.count(_U64, _POINT.size, "points")
    records = np.zeros(number, _POINT_3D)
    flat, tracks = records.view(np.uint8).reshape(number, _POINT_3D.itemsize), []
    for index in range(number):
        if source.left < _POINT.size:
            raise checks.broken(file, f"ends in the middle of point {index + 1}, at byte {len(data)}")
        at = source.at
        source.at += _POINT.size - _U64.size
        length = source.count(_U64, 2 * _U32.size, f"track elements of point {index + 1}")
        flat[index] = np.frombuffer(data, np.uint8, _POINT.size, at)
        tracks.append(source.array(np.dtype("<u4"), 2 * length))
    source.finish()
    elements = np.concatenate(tracks).reshape(-1, 2) if tracks else np.zeros((0, 2), np.uint32)
    return checks.points_of_records(
        records["id"].astype(np.int64),
        records["xyz"].astype(np.float64),
        records["rgb"].copy(),
        records["error"].astype(np.float64),
        records["length"].astype(np.int64),
        elements.astype(np.int64),
        file,
    )


def parse_rigs(data: bytes, file: str) -> dict[int, colmap.ColmapRig]:
    """The rigs by id."""

    def rig(source: _Bytes, what: str) -> tuple[int, colmap.ColmapRig]:
        number, sensors = source.take(_RIG, what)
        where = f"{file} rig {number}"
        if sensors * _SENSOR.size > source.left:
            raise checks.broken(where, f"names {sensors} sensors, but only {source.left} bytes follow")
        listed: list[tuple[colmap.Sensor, colmap.RigidPose | None]] = (
            [(_sensor(source, where), None)] if sensors else []
        )
        for _ in range(sensors - 1):
            sensor = _sensor(source, where)
            (has_pose,) = source.take(_U8, f"a sensor of rig {number}")
            if has_pose > 1:
                raise checks.broken(where, "a yes or no is neither")
            pose = (
                checks.rigid_pose(source.take(_POSE, f"a pose of rig {number}"), where) if has_pose else None
            )
            listed.append((sensor, pose))
        return number, checks.rig_of_sensors(number, listed, where)

    return _table(data, file, "rig", _RIG.size, rig)


def _sensor(source: _Bytes, where: str) -> colmap.Sensor:
    kind, number = source.take(_SENSOR, "a sensor")
    return checks.sensor_type(kind, where), number


def parse_frames(data: bytes, file: str) -> dict[int, colmap.ColmapFrame]:
    """The frames by id."""

    def frame(source: _Bytes, what: str) -> tuple[int, colmap.ColmapFrame]:
        number, rig_id, *pose, data_count = source.take(_FRAME, what)
        where = f"{file} frame {number}"
        if data_count * _DATA_ID.size > source.left:
            raise checks.broken(where, f"names {data_count} images, but only {source.left} bytes follow")
        taken = [source.take(_DATA_ID, f"frame {number}") for _ in range(data_count)]
        data_ids = tuple(
            ((checks.sensor_type(kind, where), sensor), data_id) for kind, sensor, data_id in taken
        )
        return number, colmap.ColmapFrame(number, rig_id, checks.rigid_pose(pose, where), data_ids)

    return _table(data, file, "frame", _FRAME.size, frame)
