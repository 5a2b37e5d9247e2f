"""The first guess of a lens: EXIF's focal length where it says a possible one, else a normal lens."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from PIL import Image

from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.photos.guessed_lens import exif_focal_px, guess_lens
from biresnerf.data.photos.image_files import FocalPlane, ImageHeader

FULL_FRAME = FocalPlane(6000 / 36, 4000 / 24, 6000, 4000)


def test_50_mm_on_film_fill_a_36_mm_wide_picture():
    header = ImageHeader(3000, 2000, focal_35mm=50.0)
    assert exif_focal_px(header) == pytest.approx(50 / 36 * 3000)
    turned = ImageHeader(2000, 3000, focal_35mm=50.0)
    assert exif_focal_px(turned) == pytest.approx(50 / 36 * 3000)
    # A phone's 4:3 sensor: equal diagonals, not equal widths.
    phone = ImageHeader(4000, 3000, focal_35mm=26.0)
    assert exif_focal_px(phone) == pytest.approx(26 * 5000 / math.hypot(36, 24))


def test_the_sensors_resolution_is_scaled_with_a_resized_picture():
    header = ImageHeader(1500, 1000, focal_mm=35.0, focal_plane=FULL_FRAME)
    assert exif_focal_px(header) == pytest.approx(35 / 36 * 1500)


def test_of_two_that_agree_the_finer_counts_and_of_two_that_do_not_the_film():
    agreeing = ImageHeader(6000, 4000, focal_mm=35.4, focal_35mm=35.0, focal_plane=FULL_FRAME)
    assert exif_focal_px(agreeing) == pytest.approx(35.4 / 36 * 6000)
    wrong = FULL_FRAME._replace(px_per_mm_x=300.0)
    quarrelling = ImageHeader(6000, 4000, focal_mm=35.0, focal_35mm=35.0, focal_plane=wrong)
    assert exif_focal_px(quarrelling) == pytest.approx(35 / 36 * 6000)


@pytest.mark.parametrize("focal", [None, 1.0, 5000.0])
def test_what_no_lens_has_is_not_believed(focal):
    camera, source = guess_lens(ImageHeader(600, 400, focal_35mm=focal))
    assert source == "guessed"
    assert camera.params == (1.2 * 600, 300.0, 200.0, 0.0)


def write_jpeg(path: Path, focal_35mm: int | None) -> None:
    exif = Image.Exif()
    if focal_35mm:
        exif.get_ifd(0x8769)[0xA405] = focal_35mm
    Image.new("RGB", (300, 200), (120, 90, 60)).save(path, exif=exif)


def test_a_folder_has_a_camera_for_each_focal_length_and_says_where_it_comes_from(tmp_path):
    for index, focal in enumerate([28, 28, 50, None]):
        write_jpeg(tmp_path / f"{index}.jpg", focal)
    dataset = read_dataset(tmp_path)
    assert [frame.camera for frame in dataset.frames] == [0, 0, 1, 2]
    assert dataset.intrinsics_sources == ("exif", "exif", "guessed")
    assert [round(c.params[0], 3) for c in dataset.cameras] == [233.333, 416.667, 360.0]
