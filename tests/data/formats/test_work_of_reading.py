"""Reading strangers' files takes work in proportion to their size: steps of regular expressions, names compared."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from biresnerf.data.formats.colmap.model_checks import rig_of_sensors
from biresnerf.data.formats.datasets.euroc import _read_sensor
from biresnerf.data.formats.match_names import match_files
from biresnerf.data.formats.positions import control_points as control_points_module
from biresnerf.data.formats.positions.control_points import control_points
from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.formats.registry import ALL_CODECS
from biresnerf.data.formats.unread_poses import pose_like_notes
from tests.data.regex_steps import counted_steps
from tests.data.scenes import write_image

PHOTOS = ("0.png", "1.png", "2.png")


def digits_that_are_no_number(folder: Path, size: int) -> Callable[[], object]:
    (folder / "notes.txt").write_text(size // 5 * "1" + "x")
    return lambda: pose_like_notes(folder, PHOTOS)


def matrices_without_spaces(folder: Path, size: int) -> Callable[[], object]:
    (folder / "camera.log").write_text("0 0 1\n" + size // 100 * "1")
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


CASES = (
    *(digits_that_are_no_number, matrices_without_spaces, keys_without_values, values_without_end),
    empty_lines,
)


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.__name__)
def test_the_steps_for_a_file_grow_as_its_size(
    tmp_path: Path, case: Callable[[Path, int], Callable], monkeypatch: pytest.MonkeyPatch
) -> None:
    def read(size: int) -> None:
        folder = tmp_path / str(size)
        folder.mkdir()
        case(folder, size)()

    counted_steps(monkeypatch).assert_grow_as_size(read, 2000)


class Name(str):
    """Counts how often it is compared."""

    compared = 0

    def __eq__(self, other: object) -> bool:
        Name.compared += 1
        return str.__eq__(self, other)

    __hash__ = str.__hash__


def test_names_are_looked_up_not_compared_with_each(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    files = [Name(f"images/{number}.png") for number in range(1000)]
    Name.compared = 0
    match_files([*files[::2], *map(Name, ("x", "y"))], files)
    assert Name.compared < 50 * len(files)


def test_points_of_many_names_are_looked_up_not_compared_with_each(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in PHOTOS:
        write_image(tmp_path / name, 0)
    told = [f"{at // 2} 2 3 4 5 {PHOTOS[at % 3]} point{at // 2}" for at in range(1000)]
    (tmp_path / "gcp_list.txt").write_text("\n".join(["EPSG:32632", *told]))
    dataset = read_dataset(tmp_path)
    rows, *frame = control_points_module._rows_of(tmp_path / "gcp_list.txt")
    counted = [replace(row, name=Name(row.name), image=Name(row.image)) for row in rows]
    monkeypatch.setattr(control_points_module, "_rows_of", lambda _file: (counted, *frame))
    Name.compared = 0
    control_points(dataset)
    assert Name.compared < 50 * len(rows)


def test_sensors_of_a_rig_are_looked_up_not_compared_with_each() -> None:
    sensors = [((Name("CAMERA"), number), None) for number in range(1000)]
    Name.compared = 0
    rig_of_sensors(1, sensors, "rigs.bin rig 1")
    assert Name.compared < 50 * len(sensors)


def test_a_name_of_thousands_of_digits_is_one_that_no_photo_has() -> None:
    long = "1" * 5000
    assert match_files([long, "007.jpg", "b"], ["7.jpg", "c.png"]) == (
        {"007.jpg": "7.jpg"},
        ["1 images were found by file name, with numbers compared as numbers (007.jpg is 7.jpg)"],
    )
