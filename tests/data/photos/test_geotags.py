"""GPS positions of photos, written as cameras write them."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from biresnerf.data.photos.geotags import read_geotag
from biresnerf.geometry.earth.geodesy import held_so
from tests.data.photos.geotagged import geotag, write_geotagged


@pytest.mark.parametrize(
    "place", [(50.0874, 14.4213, 195.0), (-33.8568, 151.2153, 4.5), (31.5, -35.5, -430.0)]
)
def test_signs_minutes_and_seconds_are_read(tmp_path, place):
    write_geotagged(tmp_path / "photo.jpg", place)
    np.testing.assert_allclose(read_geotag(tmp_path / "photo.jpg", "photo.jpg").place, place, atol=1e-6)


@pytest.mark.parametrize("place", [(0.0, 0.0, 0.0), (91.0, 14.0, 100.0)])
def test_what_devices_write_without_a_fix_is_no_position(tmp_path, place):
    write_geotagged(tmp_path / "photo.jpg", place)
    assert read_geotag(tmp_path / "photo.jpg", "photo.jpg") is None


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
def test_photos_without_gps_have_no_position(tmp_path, suffix):
    path = tmp_path / f"photo{suffix}"
    Image.new("RGB", (16, 16)).save(path)
    assert read_geotag(path, path.name) is None


def test_broken_tags_spoil_nothing(tmp_path):
    exif = Image.Exif()
    exif[0x8825] = {2: (48.0, 51.0), 4: (1.0, 2.0, 0.0), 6: 7.0}
    Image.new("RGB", (16, 16)).save(tmp_path / "photo.jpg", exif=exif)
    assert read_geotag(tmp_path / "photo.jpg", "photo.jpg") is None


# As DJI's drones write it (attributes), and Parrot's and MicaSense's (elements).
RTK = (
    'drone-dji:RtkFlag="{flag}" drone-dji:RtkStdLon="0.011" drone-dji:RtkStdLat="0.012"\n'
    '   drone-dji:RtkStdHgt="0.025"'
)
CAMERA = "<Camera:GPSXYAccuracy>0.02</Camera:GPSXYAccuracy><Camera:GPSZAccuracy>0.05</Camera:GPSZAccuracy>"


@pytest.mark.parametrize(
    ("text", "accuracy"),
    [
        (RTK.format(flag=50), (0.011, 0.012, 0.025)),
        (RTK.format(flag=0), None),
        (CAMERA, (0.02, 0.02, 0.05)),
        ('drone-dji:RtkStdLon="broken"', None),
    ],
)
def test_the_accuracy_that_a_drone_states_is_read(tmp_path, text, accuracy):
    path = tmp_path / "photo.jpg"
    Image.new("RGB", (16, 16)).save(path, exif=geotag(48.0, 2.0, 100.0), xmp=text.encode())
    assert read_geotag(path, path.name).accuracy_m == accuracy


@pytest.mark.parametrize(
    ("angles", "right", "forward"),
    [
        ((0, 0, 0), (1, 0, 0), (0, 1, 0)),  # level, to the north
        ((90, 0, 0), (0, -1, 0), (1, 0, 0)),  # to the east: south is on the right
        ((0, -90, 0), (1, 0, 0), (0, 0, -1)),  # straight down, with north on top
        ((90, -90, 0), (0, -1, 0), (0, 0, -1)),  # with east on top
        ((0, 0, 90), (0, 0, -1), (0, 1, 0)),  # on its right side
    ],
)
def test_a_gimbals_angles_are_a_rotation(tmp_path, angles, right, forward):
    text = " ".join(
        f'drone-dji:Gimbal{name}Degree="{angle:+.2f}"'
        for name, angle in zip(("Yaw", "Pitch", "Roll"), angles, strict=True)
    )
    path = tmp_path / "photo.jpg"
    Image.new("RGB", (16, 16)).save(path, exif=geotag(48.0, 2.0, 100.0), xmp=text.encode())
    assert read_geotag(path, path.name).angles_deg == angles
    (rotation,) = held_so(np.array([angles], dtype=float))
    np.testing.assert_allclose(rotation[:, [0, 2]].T, [right, forward], atol=1e-12)
