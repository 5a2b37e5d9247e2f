"""Photos with camera metadata: how viewers, COLMAP and our readers interpret them, against the scene."""

from __future__ import annotations

import importlib.util
import io
import math
import re
from pathlib import Path

import numpy as np
import pytest
from PIL import ExifTags, Image, ImageOps

from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.photos.decode import decode
from biresnerf.data.photos.geotags import read_geotag
from biresnerf.data.photos.guessed_lens import exif_focal_px
from biresnerf.data.photos.image_files import read_header
from biresnerf.data.synthetic.camera_photos import MAKERS, ORIGIN, turn_of
from biresnerf.data.synthetic.captures import (
    PHONE_FOCAL_OF_WIDTH,
    PHONE_FROM_SCENE,
    TABLE_METRES,
    TABLE_SCENE,
    table_textures,
    walking_cameras,
    write_walk,
)
from biresnerf.data.synthetic.scene import render_shapes
from biresnerf.geometry.earth.geodesy import east_north_up

VIEWS, WIDTH, HEIGHT, SEED = 3, 64, 48, 2
FOCAL = PHONE_FOCAL_OF_WIDTH * WIDTH


@pytest.fixture(scope="module", params=MAKERS)
def walk(request, tmp_path_factory) -> tuple[str, Path]:
    """A maker, and the folder of a walk that its camera took photos of."""
    folder = tmp_path_factory.mktemp(request.param)
    write_walk(folder, VIEWS, WIDTH, SEED, MAKERS[request.param])
    return request.param, folder


def photos(folder: Path) -> list[Path]:
    return sorted((folder / "images").iterdir())


def differ(found: np.ndarray, pose: np.ndarray) -> float:
    """Mean difference in brightness, of 255, of a photo [h, w, 3] from the scene: colours have half the size."""
    height, width = found.shape[:2]
    true = render_shapes(TABLE_SCENE, table_textures(SEED), pose, width, height, FOCAL)[0][..., :3]
    grey = [np.asarray(Image.fromarray(picture).convert("L"), float) for picture in (found, true.copy())]
    return float(np.abs(grey[0] - grey[1]).mean())


def test_viewers_show_the_upright_scene_whichever_way_its_pixels_are_stored(walk):
    maker, folder = walk
    for number, (path, pose) in enumerate(zip(photos(folder), walking_cameras(VIEWS, SEED), strict=True)):
        stored = Image.open(path)
        assert stored.size == (WIDTH, HEIGHT)  # as the sensor has them
        assert stored.getexif()[ExifTags.Base.Orientation] == turn_of(MAKERS[maker], number)
        assert differ(np.asarray(ImageOps.exif_transpose(stored)), pose) < 4


def test_the_files_poses_and_lens_are_those_of_the_stored_pixels(walk):
    dataset = read_dataset(walk[1])
    for index, frame in enumerate(dataset.frames):
        camera, pose = dataset.camera_of(index), frame.world_from_cam
        assert camera.full().fx == pytest.approx(FOCAL)
        pose[:3, 3] /= TABLE_METRES
        assert differ(decode(frame, camera), np.linalg.inv(PHONE_FROM_SCENE) @ pose) < 4


def test_the_focal_length_that_is_said_is_the_lenss(walk):
    maker, folder = walk
    for path in photos(folder):
        header = read_header(path, path.name)
        assert header.focal_mm == pytest.approx(FOCAL / WIDTH * MAKERS[maker].sensor_mm, rel=1e-4)
        if MAKERS[maker].film:
            assert exif_focal_px(header) == pytest.approx(FOCAL, rel=0.02)  # whole millimetres
        else:
            assert exif_focal_px(header) is None


@pytest.mark.skipif(
    importlib.util.find_spec("pycolmap") is None, reason="pycolmap is not installed (extra: colmap)"
)
def test_colmap_reads_the_same_focal_length(walk):
    import pycolmap

    maker, folder = walk
    camera = pycolmap.infer_camera_from_image(str(photos(folder)[0]))
    assert camera.has_prior_focal_length == MAKERS[maker].film
    if camera.has_prior_focal_length:
        assert camera.mean_focal_length() == pytest.approx(FOCAL, rel=0.02)


def test_positions_are_as_far_off_as_they_say(walk):
    maker, folder = walk
    error_m, unit_m = MAKERS[maker].gps_m, MAKERS[maker].unit_m
    for path, pose in zip(photos(folder), walking_cameras(VIEWS, SEED), strict=True):
        found = read_geotag(path, path.name)
        if error_m is None:
            assert found is None
            continue
        off = east_north_up(np.array(found.place), ORIGIN) - unit_m * pose[:3, 3]
        assert 0 < np.linalg.norm(off) < 4 * error_m


def test_a_file_has_the_makers_name_the_time_a_note_and_a_thumbnail(walk):
    maker, folder = walk
    times = []
    for path in photos(folder):
        exif = Image.open(path).getexif()
        assert exif[ExifTags.Base.Make] == MAKERS[maker].make
        details = exif.get_ifd(ExifTags.IFD.Exif)
        head, length = MAKERS[maker].note
        assert details[ExifTags.Base.MakerNote].startswith(head)
        assert len(details[ExifTags.Base.MakerNote]) == length
        times.append(details[ExifTags.Base.DateTimeOriginal])
        small = exif.get_ifd(ExifTags.IFD.IFD1)
        start = path.read_bytes().index(b"Exif\0\0") + 6 + small[ExifTags.Base.JpegIFOffset]
        content = path.read_bytes()[start : start + small[ExifTags.Base.JpegIFByteCount]]
        assert Image.open(io.BytesIO(content)).convert("L").size == (WIDTH, HEIGHT)
    assert times == sorted(set(times))


def test_a_drone_says_how_its_gimbal_pointed(tmp_path):
    write_walk(tmp_path, VIEWS, WIDTH, SEED, MAKERS["drone"])
    for path, pose in zip(photos(tmp_path), walking_cameras(VIEWS, SEED), strict=True):
        said = dict(re.findall(rb'drone-dji:(\w+)="([^"]*)"', Image.open(path).info["xmp"]))
        yaw, pitch = (math.radians(float(said[b"Gimbal%sDegree" % name])) for name in (b"Yaw", b"Pitch"))
        forward = math.cos(pitch) * math.sin(yaw), math.cos(pitch) * math.cos(yaw), math.sin(pitch)
        np.testing.assert_allclose(forward, pose[:3, 2], atol=1e-3)
