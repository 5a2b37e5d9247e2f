"""COLMAP's text tables, parsed line by line.

Layouts: src/colmap/scene/reconstruction_io_text.cc. An image's name is the whole rest of its line: COLMAP's own
reader cuts it at the first space, which loses names that COLMAP's own writer wrote.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from biresnerf.data.formats.colmap import model_checks as checks
from biresnerf.data.model import colmap_scene as colmap
from biresnerf.geometry.camera.camera_models import Camera

T = TypeVar("T")
_MAX_ID = 2**63 - 1
_MAX_SHORT_ID = 2**32 - 2  # of cameras, images, rigs, frames and sensors
_NO_POINT_WORDS = ("-1", str(2**64 - 1))


class _Words:
    """The words of one line, taken from the left."""

    def __init__(self, line: str, where: str) -> None:
        self.words, self.where, self.at = line.split(), where, 0

    def word(self, what: str) -> str:
        if self.at >= len(self.words):
            raise checks.broken(self.where, f"the line ends before {what}")
        self.at += 1
        return self.words[self.at - 1]

    def integer(self, what: str) -> int:
        word = self.word(what)
        if not (word.isascii() and word.isdecimal() and len(word) < 20) or int(word) > _MAX_ID:
            raise checks.broken(self.where, f"{what} is {word[:40]!r}, not a whole number")
        return int(word)

    def identifier(self, what: str) -> int:
        """A whole number that COLMAP's binary tables can hold, in which the largest stands for none."""
        number = self.integer(what)
        if number > _MAX_SHORT_ID:
            raise checks.broken(self.where, f"{what} is {number}, more than {_MAX_SHORT_ID}")
        return number

    def numbers(self, count: int, what: str) -> list[float]:
        words = [self.word(what) for _ in range(count)]
        return list(floats(words, self.where, what))

    def finish(self) -> None:
        if self.at < len(self.words):
            raise checks.broken(
                self.where, f"{len(self.words) - self.at} words more than the line should have"
            )


def floats(words: list[str], where: str, what: str) -> NDArray[np.float64]:
    """The words as float64 [n], NaN and infinity among them. Raises InputError where one is not a number."""
    try:
        return np.array([float(word) for word in words], dtype=np.float64)
    except ValueError:
        raise checks.broken(where, f"{what}: not a number") from None


def _integers(words: list[str], where: str, what: str) -> NDArray[np.int64]:
    try:
        return np.array([int(word) for word in words], dtype=np.int64)
    except (ValueError, OverflowError):
        raise checks.broken(where, f"{what}: not a whole number") from None


def _lines(text: str, file: str) -> Iterator[tuple[str, str]]:
    """Each line that says something, and where it stands."""
    for number, line in enumerate(text.split("\n"), start=1):
        stripped = line.strip()
        if stripped and not stripped.startswith("#"):
            yield stripped, f"{file} line {number}"


def _table(text: str, file: str, parse: Callable[[_Words], tuple[int, T]]) -> dict[int, T]:
    table: dict[int, T] = {}
    for line, where in _lines(text, file):
        words = _Words(line, where)
        number, row = parse(words)
        words.finish()
        checks.refuse_repeated(table, number, f"{where}: id")
        table[number] = row
    return table


def parse_cameras(text: str, file: str) -> dict[int, Camera]:
    """The cameras by id."""

    def camera(words: _Words) -> tuple[int, Camera]:
        number = words.identifier("the camera's id")
        model = checks.supported_model(words.word("the camera's model"), words.where)
        width, height = words.integer("the width"), words.integer("the height")
        params = words.numbers(len(words.words) - words.at, "the parameters")
        return number, checks.camera_of_numbers(model, width, height, params, words.where)

    return _table(text, file, camera)


def parse_images(text: str, file: str) -> dict[int, colmap.ColmapImage]:
    """The registered images by id: two lines each, of which the second, with the features, may be empty."""
    images: dict[int, colmap.ColmapImage] = {}
    lines = iter(enumerate(text.split("\n"), start=1))
    for number_of_line, line in lines:
        where = f"{file} line {number_of_line}"
        if not line.strip() or line.strip().startswith("#"):
            continue
        parts = line.strip().split(maxsplit=9)
        words = _Words(" ".join(parts[:9]), where)
        number, pose = words.identifier("the image's id"), words.numbers(7, "the pose")
        camera_id = words.identifier("the camera's id")
        if len(parts) < 10:
            raise checks.broken(where, "the line ends before the image's name")
        name = checks.image_name(parts[9], where)
        _, features = next(lines, (0, ""))
        xy, ids = _features(features, f"{file} line {number_of_line + 1}")
        checks.refuse_repeated(images, number, f"{where}: id")
        images[number] = colmap.ColmapImage(number, name, camera_id, checks.rigid_pose(pose, where), xy, ids)
    return images


def _features(line: str, where: str) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    words = line.split()
    if len(words) % 3:
        raise checks.broken(
            where,
            "not a list of x, y, point id; each image has two lines, the second may be empty",
            hint="Write an empty line after each image that has no features.",
        )
    numbers = floats(words, where, "a feature").reshape(-1, 3)
    checks.check_features(numbers[:, :2], where)
    ids = ["-1" if word in _NO_POINT_WORDS else word for word in words[2::3]]
    return numbers[:, :2].copy(), _integers(ids, where, "a point's id")


def parse_points(text: str, file: str) -> colmap.ColmapPoints:
    """The 3D points in the file's order."""
    ids: list[int] = []
    values: list[list[float]] = []
    lengths: list[int] = []
    elements: list[int] = []
    for line, where in _lines(text, file):
        words = line.split()
        if len(words) < 8 or len(words) % 2:
            raise checks.broken(where, "not an id, three coordinates, a colour, an error and a track")
        try:
            ids.append(int(words[0]))
            values.append([float(word) for word in words[1:8]])
            elements += [int(word) for word in words[8:]]
        except ValueError:
            raise checks.broken(where, "holds a word that is not a number, or not a whole one") from None
        lengths.append(len(words) // 2 - 4)
    if not ids:
        return colmap.no_points()
    numbers = np.array(values)
    rgb = numbers[:, 3:6]
    if not ((rgb >= 0) & (rgb <= 255) & (rgb == np.round(rgb))).all():
        raise checks.broken(file, "a point's colour is not three whole numbers from 0 to 255")
    return checks.points_of_records(
        _bounded(ids, file),
        numbers[:, :3].copy(),
        rgb.astype(np.uint8),
        numbers[:, 6].copy(),
        np.array(lengths, np.int64),
        _bounded(elements, file).reshape(-1, 2),
        file,
    )


def _bounded(ids: list[int], file: str) -> NDArray[np.int64]:
    if any(not 0 <= number <= _MAX_ID for number in ids):
        raise checks.broken(file, "an id is out of range")
    return np.array(ids, dtype=np.int64)


def _sensor(words: _Words) -> colmap.Sensor:
    name = words.word("a sensor's type")
    number = words.identifier("a sensor's id")
    kind = colmap.SENSOR_TYPES.index(name) if name in colmap.SENSOR_TYPES else -1
    return checks.sensor_type(kind, words.where), number


def _pose(words: _Words, what: str) -> colmap.RigidPose:
    return checks.rigid_pose(words.numbers(7, what), words.where)


def parse_rigs(text: str, file: str) -> dict[int, colmap.ColmapRig]:
    """The rigs by id."""

    def rig(words: _Words) -> tuple[int, colmap.ColmapRig]:
        number, sensors = words.identifier("the rig's id"), words.integer("the number of sensors")
        listed: list[tuple[colmap.Sensor, colmap.RigidPose | None]] = (
            [(_sensor(words), None)] if sensors else []
        )
        for _ in range(min(sensors, len(words.words)) - 1):
            sensor = _sensor(words)
            has_pose = words.word("whether a sensor has a pose")
            if has_pose not in ("0", "1"):
                raise checks.broken(words.where, "a yes or no is neither")
            listed.append((sensor, _pose(words, "a sensor's pose") if has_pose == "1" else None))
        return number, checks.rig_of_sensors(number, listed, words.where)

    return _table(text, file, rig)


def parse_frames(text: str, file: str) -> dict[int, colmap.ColmapFrame]:
    """The frames by id."""

    def frame(words: _Words) -> tuple[int, colmap.ColmapFrame]:
        number, rig_id = words.identifier("the frame's id"), words.identifier("the rig's id")
        pose = _pose(words, "the frame's pose")
        count = words.integer("the number of images")
        if 3 * count > len(words.words):
            raise checks.broken(words.where, f"names {count} images, but the line is shorter")
        data_ids = tuple((_sensor(words), words.integer("an image's id")) for _ in range(count))
        return number, colmap.ColmapFrame(number, rig_id, pose, data_ids)

    return _table(text, file, frame)
