"""COLMAP's tables, binary or text: each layout is declared once, on top of readers of bytes and of words.

Layouts: src/colmap/scene/reconstruction_io_binary.cc, little-endian throughout, and reconstruction_io_text.cc. Nothing
is allocated before the file is known to hold it. `model_checks` compares the tables with each other.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.formats.colmap import model_checks as checks
from biresnerf.data.model import colmap_scene as colmap
from biresnerf.geometry.camera.camera_models import MODEL_PARAMETERS, Camera

Row = TypeVar("Row")
_ID = np.dtype("<u4")
_POINT_2D = np.dtype([("xy", "<f8", 2), ("id", "<u8")])
_POINT_3D = np.dtype(
    [("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("length", "<u8")]
)
_MAX_NAME_BYTES = 4096
_MAX_ID = 2**63 - 1
_MAX_SHORT_ID = 2**32 - 2  # of cameras, images, rigs, frames and sensors
_NO_POINT_WORDS = ("-1", str(2**64 - 1))


class BinaryTable:
    """A table's bytes, and how far its fields were taken."""

    def __init__(self, data: bytes, file: str) -> None:
        self.data, self.file, self.at = data, file, 0

    def rows(self) -> Iterator[None]:
        """Yields at each row, so that the caller takes its fields; refuses bytes after the last one."""
        for _ in range(self.whole("the number of rows")):
            yield
        self._finish()

    def _finish(self) -> None:
        if self.at < len(self.data):
            raise checks.broken(self.file, f"{len(self.data) - self.at} bytes follow the last record")

    def place(self, row: str) -> str:
        """Where a row is, for messages."""
        return f"{self.file} {row}"

    def _array(self, dtype: np.dtype[Any], count: int, what: str) -> NDArray[Any]:
        start, self.at = self.at, self.at + count * dtype.itemsize
        if self.at > len(self.data):
            raise checks.broken(self.file, f"ends in the middle of {what}, at byte {len(self.data)}")
        return np.frombuffer(self.data, dtype, count, start)

    def _number(self, kind: np.dtype[Any], what: str) -> int:
        return int(self._array(kind, 1, what)[0])

    def identifier(self, what: str) -> int:
        return self._number(_ID, what)

    def whole(self, what: str) -> int:
        return self._number(np.dtype("<u8"), what)

    def numbers(self, count: int, what: str) -> list[float]:
        found: list[float] = self._array(np.dtype("<f8"), count, what).tolist()
        return found

    def is_so(self, what: str) -> bool:
        found = self._number(np.dtype("u1"), what)
        if found > 1:
            raise checks.broken(self.file, f"{what}: a yes or no is neither")
        return found == 1

    def model(self, where: str) -> str:
        return checks.model_name_of_id(self._number(np.dtype("<i4"), "the camera's model"), where)

    def params(self, model: str) -> list[float]:
        return self.numbers(len(MODEL_PARAMETERS[model]), "the camera's parameters")

    def sensor(self, where: str) -> colmap.Sensor:
        kind = self._number(np.dtype("<i4"), "a sensor's type")
        return checks.sensor_type(kind, where), self.identifier("a sensor's id")

    def name(self) -> bytes:
        end = self.data.find(b"\0", self.at, self.at + _MAX_NAME_BYTES)
        if end < 0:
            raise checks.broken(self.file, "an image's name has no end")
        start, self.at = self.at, end + 1
        return self.data[start:end]

    def features(self, where: str) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        points = self._array(_POINT_2D, self.whole("the number of features"), "an image's features")
        checks.check_features(points["xy"], where)
        # COLMAP's mark of no point, 2^64 - 1, becomes NO_POINT.
        return points["xy"].astype(np.float64), points["id"].astype(np.int64)

    def points(self) -> colmap.ColmapPoints:
        number = self.whole("the number of points")
        if number * _POINT_3D.itemsize > len(self.data):
            raise checks.broken(self.file, f"names {number} points, but has only {len(self.data)} bytes")
        records = np.zeros(number, _POINT_3D)
        tracks, lengths = [], records["length"]
        for index in range(number):
            records[index : index + 1] = self._array(_POINT_3D, 1, "a point")
            tracks.append(self._array(_ID, 2 * int(lengths[index]), "a point's track"))
        self._finish()
        elements = np.concatenate(tracks).reshape(-1, 2) if tracks else np.zeros((0, 2), np.uint32)
        return checks.points_of_records(
            records["id"].astype(np.int64),
            records["xyz"].astype(np.float64),
            records["rgb"].copy(),
            records["error"].astype(np.float64),
            records["length"].astype(np.int64),
            elements.astype(np.int64),
            self.file,
        )


class TextTable:
    """A table's lines, and the words of one of them.

    An image's name is the whole rest of its line: COLMAP's own reader cuts it at the first space, which loses names
    that COLMAP's own writer wrote.
    """

    def __init__(self, text: str, file: str) -> None:
        self.file, self.where, self.line = file, file, ""
        self.words: list[str] = []
        self.at = 0
        self.lines = iter(enumerate(text.split("\n"), start=1))

    def rows(self) -> Iterator[None]:
        """Yields at each line with content, so that the caller takes its words; refuses words left over."""
        for number, line in self.lines:
            self.line, self.words, self.at = line.strip(), line.split(), 0
            self.where = f"{self.file} line {number}"
            if not self.words or self.line.startswith("#"):
                continue
            yield
            if self.at < len(self.words):
                more = len(self.words) - self.at
                raise checks.broken(self.where, f"{more} words more than the line should have")

    def place(self, row: str) -> str:
        """Where a row is, for messages."""
        return self.where

    def _word(self, what: str) -> str:
        if self.at >= len(self.words):
            raise checks.broken(self.where, f"the line ends before {what}")
        self.at += 1
        return self.words[self.at - 1]

    def identifier(self, what: str) -> int:
        """A whole number that COLMAP's binary tables can hold, in which the largest stands for none."""
        number = self.whole(what)
        if number > _MAX_SHORT_ID:
            raise checks.broken(self.where, f"{what} is {number}, more than {_MAX_SHORT_ID}")
        return number

    def whole(self, what: str) -> int:
        word = self._word(what)
        if not (word.isascii() and word.isdecimal() and len(word) < 20) or int(word) > _MAX_ID:
            raise checks.broken(self.where, f"{what} is {word[:40]!r}, not a whole number")
        return int(word)

    def numbers(self, count: int, what: str) -> list[float]:
        return list(floats([self._word(what) for _ in range(count)], self.where, what))

    def is_so(self, what: str) -> bool:
        word = self._word(what)
        if word not in ("0", "1"):
            raise checks.broken(self.where, f"{what}: a yes or no is neither")
        return word == "1"

    def model(self, where: str) -> str:
        return checks.supported_model(self._word("the camera's model"), where)

    def params(self, model: str) -> list[float]:
        return self.numbers(len(self.words) - self.at, "the parameters")

    def sensor(self, where: str) -> colmap.Sensor:
        name = self._word("a sensor's type")
        kind = colmap.SENSOR_TYPES.index(name) if name in colmap.SENSOR_TYPES else -1
        return checks.sensor_type(kind, where), self.identifier("a sensor's id")

    def name(self) -> str:
        self._word("the image's name")
        name = self.line.split(maxsplit=self.at - 1)[-1]
        self.at = len(self.words)
        return name

    def features(self, where: str) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """The features in the next line, which may be empty."""
        number, line = next(self.lines, (0, ""))
        where, words = f"{self.file} line {number}", line.split()
        if len(words) % 3:
            raise checks.broken(
                where,
                "not a list of x, y, point id; each image has two lines, the second may be empty",
                hint="Write an empty line after each image that has no features.",
            )
        numbers = floats(words, where, "a feature").reshape(-1, 3)
        checks.check_features(numbers[:, :2], where)
        try:
            ids = [-1 if word in _NO_POINT_WORDS else int(word) for word in words[2::3]]
            return numbers[:, :2].copy(), np.array(ids, dtype=np.int64)
        except (ValueError, OverflowError):
            raise checks.broken(where, "a point's id: not a whole number") from None

    def points(self) -> colmap.ColmapPoints:
        ids: list[int] = []
        values: list[list[float]] = []
        lengths: list[int] = []
        elements: list[int] = []
        for _ in self.rows():
            words, self.at = self.words, len(self.words)
            if len(words) < 8 or len(words) % 2:
                raise checks.broken(
                    self.where, "not an id, three coordinates, a colour, an error and a track"
                )
            try:
                ids.append(int(words[0]))
                values.append([float(word) for word in words[1:8]])
                elements += [int(word) for word in words[8:]]
            except ValueError:
                what = "holds a word that is not a number, or not a whole one"
                raise checks.broken(self.where, what) from None
            lengths.append(len(words) // 2 - 4)
        if not ids:
            return colmap.no_points()
        if any(not 0 <= number <= _MAX_ID for number in (*ids, *elements)):
            raise checks.broken(self.file, "an id is out of range")
        numbers = np.array(values)
        rgb = numbers[:, 3:6]
        if not ((rgb >= 0) & (rgb <= 255) & (rgb == np.round(rgb))).all():
            raise checks.broken(self.file, "a point's colour is not three whole numbers from 0 to 255")
        return checks.points_of_records(
            np.array(ids, np.int64),
            numbers[:, :3].copy(),
            rgb.astype(np.uint8),
            numbers[:, 6].copy(),
            np.array(lengths, np.int64),
            np.array(elements, np.int64).reshape(-1, 2),
            self.file,
        )


Table = BinaryTable | TextTable


def floats(words: list[str], where: str, what: str) -> NDArray[np.float64]:
    """The words as float64 [n], NaN and infinity among them. Raises InputError where one is not a number."""
    try:
        return np.array([float(word) for word in words], dtype=np.float64)
    except ValueError:
        raise checks.broken(where, f"{what}: not a number") from None


def _by_id(table: Table, kind: str, read: Callable[[Table, int, str], Row]) -> dict[int, Row]:
    """The rows by id; ``read`` takes what follows the id, given it and the row's place."""
    found: dict[int, Row] = {}
    for _ in table.rows():
        number = table.identifier(f"the {kind}'s id")
        where = table.place(f"{kind} {number}")
        if number in found:
            raise checks.broken(where, f"two rows have the id {number}")
        found[number] = read(table, number, where)
    return found


def _pose(table: Table, where: str) -> colmap.RigidPose:
    return checks.rigid_pose(table.numbers(7, "a pose"), where)


def _camera(table: Table, number: int, where: str) -> Camera:
    model = table.model(where)
    width, height = table.whole("the width"), table.whole("the height")
    return checks.camera_of_numbers(model, width, height, table.params(model), where)


def _image(table: Table, number: int, where: str) -> colmap.ColmapImage:
    pose, camera_id = table.numbers(7, "the pose"), table.identifier("the camera's id")
    name = checks.image_name(table.name(), where)
    features = table.features(where)
    return colmap.ColmapImage(number, name, camera_id, checks.rigid_pose(pose, where), *features)


def _rig(table: Table, number: int, where: str) -> colmap.ColmapRig:
    count = table.identifier("the number of sensors")
    listed: list[tuple[colmap.Sensor, colmap.RigidPose | None]] = []
    if count:
        listed.append((table.sensor(where), None))
    for _ in range(count - 1):
        sensor = table.sensor(where)
        has_pose = table.is_so("whether a sensor has a pose")
        listed.append((sensor, _pose(table, where) if has_pose else None))
    return checks.rig_of_sensors(number, listed, where)


def _frame(table: Table, number: int, where: str) -> colmap.ColmapFrame:
    rig_id, pose = table.identifier("the rig's id"), _pose(table, where)
    count = table.identifier("the number of images")
    taken = tuple((table.sensor(where), table.whole("an image's id")) for _ in range(count))
    return colmap.ColmapFrame(number, rig_id, pose, taken)


def read_cameras(table: Table) -> dict[int, Camera]:
    """The cameras by id."""
    return _by_id(table, "camera", _camera)


# What takes each table's content; the rows of all but points3D are by id.
READERS: dict[str, Callable[[Table], Any]] = {
    "cameras": read_cameras,
    "images": lambda table: _by_id(table, "image", _image),
    "points3D": lambda table: table.points(),
    "rigs": lambda table: _by_id(table, "rig", _rig),
    "frames": lambda table: _by_id(table, "frame", _frame),
}
