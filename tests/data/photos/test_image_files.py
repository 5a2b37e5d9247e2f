"""What is read of an image file without decoding it: size, EXIF orientation, focal length."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from biresnerf.data.photos.image_files import FocalPlane, ImageHeader, read_header
from biresnerf.errors import InputError

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
    path = tmp_path / "cut.png"
    Image.fromarray(np.zeros((400, 400, 3), dtype=np.uint8)).save(path)
    path.write_bytes(path.read_bytes()[:60])  # who wants pixels finds none
    assert read_header(path, "cut").width == 400


@pytest.mark.parametrize("suffix", [".tif", ".webp", ".png"])
def test_pages_and_frames_behind_the_first_are_noticed(tmp_path, suffix):
    path = tmp_path / f"pages{suffix}"
    PHOTO.save(path, save_all=True, append_images=[Image.new("RGB", PHOTO.size)])
    assert read_header(path, "pages").several


def jpeg_with(path, start: bytes):
    """A JPEG with these bytes behind its first mark."""
    Image.new("RGB", (8, 6)).save(path, "JPEG")
    path.write_bytes(b"\xff\xd8" + start + path.read_bytes()[2:])
    return path


EXIF_PIECE = b"\xff\xe1\x00\x10Exif\0\0abcdefgh"


@pytest.mark.parametrize(
    "start",
    [EXIF_PIECE * 1_000_000, b"\xff" * 2_000_000 + EXIF_PIECE, b"\xff\xd0" * 9 + b"\xff\xff" + EXIF_PIECE * 100_000,
     b"\xff\xe5\x00\x04ab" * 500_000],
    ids=["exif", "fill", "exif behind fill", "other segments"],
)  # fmt: skip
def test_a_jpeg_whose_head_is_in_a_million_pieces_is_refused_by_its_name_at_once(
    tmp_path, start, monkeypatch
):
    path = jpeg_with(tmp_path / "a.jpg", start)
    opened = []
    monkeypatch.setattr(Image, "open", lambda *_, **__: opened.append(path))
    with pytest.raises(InputError, match="pieces") as caught:
        read_header(path, "a.jpg")
    assert (caught.value.code, caught.value.where) == ("not_an_image", "a.jpg")
    assert not opened, "before Pillow looks at each piece"


def test_a_jpeg_with_a_long_profile_and_a_depth_map_in_its_head_is_read(tmp_path):
    start = EXIF_PIECE + b"\xff" * 30 + (b"\xff\xe1\xff\xff" + b"x" * 65_533) * 300
    assert read_header(jpeg_with(tmp_path / "a.jpg", start), "a.jpg")[:2] == (8, 6)
