"""What is read of an image file without decoding it: size, EXIF orientation, focal length."""

from __future__ import annotations

import time

import numpy as np
import pytest
from PIL import Image

from biresnerf.data.photos.image_files import FocalPlane, ImageHeader, read_header

PHOTO = Image.new("RGB", (30, 20), (10, 120, 240))
SUFFIXES = [".jpg", ".png", ".webp", ".tif"]


def _exif(orientation: int = 1, **details: object) -> Image.Exif:
    exif = Image.Exif()
    exif[0x0112] = orientation
    tags = {
        "focal": 0x920A,
        "focal_35mm": 0xA405,
        "x": 0xA20E,
        "y": 0xA20F,
        "unit": 0xA210,
        "w": 0xA002,
        "h": 0xA003,
    }
    for name, value in details.items():
        exif.get_ifd(0x8769)[tags[name]] = value
    return exif


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_orientation_and_focal_length_are_read_from_every_format(tmp_path, suffix):
    path = tmp_path / f"photo{suffix}"
    details = _exif(6, focal=4.25, focal_35mm=26, x=8000.0, y=8200.0, unit=3, w=60, h=40)
    PHOTO.save(path, exif=details.tobytes())  # as bytes, or the TIFF writer leaves half of it out
    header = read_header(path, "photo")
    assert (header.width, header.height, header.orientation) == (30, 20, 6)
    assert header.focal_mm == pytest.approx(4.25)
    assert header.focal_35mm == 26
    assert header.focal_plane == pytest.approx(FocalPlane(800.0, 820.0, 60, 40))


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_file_without_exif_says_nothing_of_it(tmp_path, suffix):
    path = tmp_path / f"photo{suffix}"
    PHOTO.save(path)
    assert read_header(path, "photo") == ImageHeader(30, 20)


@pytest.mark.parametrize(
    ("unit", "px_per_mm"), [(None, 100 / 25.4), (2, 100 / 25.4), (3, 10), (4, 100), (5, 1e5)]
)
def test_the_sensor_is_measured_in_the_unit_that_exif_names(tmp_path, unit, px_per_mm):
    path = tmp_path / "photo.jpg"
    details = {"x": 100.0} if unit is None else {"x": 100.0, "unit": unit}
    PHOTO.save(path, exif=_exif(**details))
    assert read_header(path, "photo").focal_plane == pytest.approx(FocalPlane(px_per_mm, px_per_mm, 0, 0))


def test_claims_that_no_camera_can_make_are_not_passed_on(tmp_path):
    path = tmp_path / "photo.jpg"
    for details in ({"focal": 0.0, "focal_35mm": 0}, {"x": 0.0, "y": 0.0}, {"x": 100.0, "unit": 77}):
        PHOTO.save(path, exif=_exif(12, **details))
        assert read_header(path, "photo") == ImageHeader(30, 20)


def test_the_header_of_a_png_is_read_without_its_pixels(tmp_path):
    path = tmp_path / "large.png"
    Image.fromarray(np.zeros((4000, 4000, 3), dtype=np.uint8)).save(path, compress_level=1)
    started = time.perf_counter()
    assert read_header(path, "large").width == 4000
    decoding = time.perf_counter()
    with Image.open(path) as image:
        image.load()
    assert decoding - started < 0.2 * (time.perf_counter() - decoding)


@pytest.mark.parametrize("suffix", [".tif", ".webp", ".png"])
def test_pages_and_frames_behind_the_first_are_noticed(tmp_path, suffix):
    path = tmp_path / f"pages{suffix}"
    PHOTO.save(path, save_all=True, append_images=[Image.new("RGB", PHOTO.size)])
    assert read_header(path, "pages").several
