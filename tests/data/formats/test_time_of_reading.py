"""Files of strangers take time as their size, whatever is in them."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from biresnerf.data.formats.datasets.euroc import _read_sensor
from biresnerf.data.formats.match_names import match_files
from biresnerf.data.formats.positions.control_points import control_points
from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.formats.registry import ALL_CODECS
from biresnerf.data.formats.unread_poses import pose_like_notes
from biresnerf.errors import InputError
from tests.data.scenes import write_image

PHOTOS = ("0.png", "1.png", "2.png")


def digits_that_are_no_number(folder: Path, size: int) -> Callable[[], object]:
    (folder / "notes.txt").write_text(size * "1" + "x")
    return lambda: pose_like_notes(folder, PHOTOS)


def matrices_without_spaces(folder: Path, size: int) -> Callable[[], object]:
    (folder / "camera.log").write_text("0 0 1\n" + size // 25 * "1")
    return lambda: ALL_CODECS["tanks-and-temples"].recognises(folder / "camera.log")


def keys_without_values(folder: Path, size: int) -> Callable[[], object]:
    (folder / "sensor.yaml").write_text(size // 4 * "T_BS:")
    return lambda: _read_sensor(folder / "sensor.yaml")


def values_without_end(folder: Path, size: int) -> Callable[[], object]:
    (folder / "sensor.yaml").write_text(size // 4 * "T_BS:[")
    return lambda: _read_sensor(folder / "sensor.yaml")


def empty_lines(folder: Path, size: int) -> Callable[[], object]:
    numbers = {"T_BS": 16, "intrinsics": 4, "distortion_coefficients": 4, "resolution": 2}
    there = [f"{key}: [{','.join(['1', *(count - 1) * ['0']])}]" for key, count in numbers.items()]
    there[0] = "T_BS: [1,0,0,0, 0,1,0,0, 0,0,1,0, 0,0,0,1]"
    (folder / "sensor.yaml").write_text("\n".join(there) + size * "\n")
    return lambda: _read_sensor(folder / "sensor.yaml")


def points_of_many_names(folder: Path, size: int) -> Callable[[], object]:
    for name in PHOTOS:
        write_image(folder / name, 0)
    rows = [f"{at} 2 3 4 5 {PHOTOS[at % 3]} point{at}" for at in range(size // 4)]
    (folder / "gcp_list.txt").write_text("\n".join(["EPSG:32632", *rows]))
    dataset = read_dataset(folder)
    return lambda: control_points(dataset)


def names_of_photos(folder: Path, size: int) -> Callable[[], object]:
    files = [f"images/{number}.png" for number in range(size // 8)]
    return lambda: match_files(files, files)


CASES = (
    *(digits_that_are_no_number, matrices_without_spaces, keys_without_values, values_without_end),
    *(empty_lines, points_of_many_names, names_of_photos),
)


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.__name__)
def test_the_time_for_a_file_grows_as_its_size(tmp_path: Path, case: Callable[[Path, int], Callable]) -> None:
    def processor_s(size: int) -> float:
        folder = tmp_path / str(size)
        folder.mkdir()
        read = case(folder, size)
        took = []
        for _ in range(3):  # other programs make a processor slower, never faster
            begun = time.process_time()
            with contextlib.suppress(InputError):
                read()
            took.append(time.process_time() - begun)
        return min(took)

    assert processor_s(40_000) < 8 * processor_s(10_000) + 0.25


def test_a_name_of_thousands_of_digits_is_one_that_no_photo_has() -> None:
    long = "1" * 5000
    assert match_files([long, "007.jpg", "b"], ["7.jpg", "c.png"]) == (
        {"007.jpg": "7.jpg"},
        ["1 images were found by file name, with numbers compared as numbers (007.jpg is 7.jpg)"],
    )
