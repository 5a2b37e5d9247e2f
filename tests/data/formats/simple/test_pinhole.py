"""Undistorted photos: each pixel shows what its ray saw in the photo, checked by COLMAP's lens and another sampler."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import gaussian_filter, map_coordinates

from biresnerf.data.formats.colmap.read_model import read_colmap_model
from biresnerf.data.formats.simple.pinhole import pinhole_camera, undistorted, write_pinhole
from biresnerf.errors import InputError
from biresnerf.geometry.camera.camera_models import MODEL_PARAMETERS, Camera
from biresnerf.geometry.camera.pixel_rays import pixels_of_points
from tests.data.formats.random_sets import random_camera, random_result
from tests.data.formats.readers import bundler_cameras, ours, seen_points, through_bundler
from tests.data.scenes import assert_complete

SIZE = (160, 120)
PYCOLMAP = """
import zlib, json, sys
import numpy as np, pycolmap
answer = []
for model, width, height, params, f, w, h in json.load(sys.stdin):
    camera = pycolmap.Camera(model=model, width=width, height=height, params=params)
    y, x = np.mgrid[0:h, 0:w] + 0.5
    rays = np.stack([(x - w / 2) / f, (y - h / 2) / f, np.ones_like(x)], -1).reshape(-1, 3)
    answer.append(np.array(camera.img_from_cam(rays)).tolist())
json.dump(answer, sys.stdout)
"""


def photo(seed, channels=3, size=SIZE):
    rng = np.random.default_rng(seed)
    smooth = gaussian_filter(rng.uniform(0, 255, (size[1], size[0], channels)), (3, 3, 0))
    smooth = (smooth - smooth.min()) / np.ptp(smooth) * 255
    return smooth.astype(np.uint8)


@pytest.mark.skipif(importlib.util.find_spec("pycolmap") is None, reason="pycolmap is not installed")
def test_every_pixel_shows_what_colmaps_lens_says_its_ray_met():
    rng = np.random.default_rng(0)
    cameras = [random_camera(rng, model, SIZE) for model in sorted(MODEL_PARAMETERS)]
    flat = [pinhole_camera(camera) for camera in cameras]
    asked = [
        [c.model, c.width, c.height, list(c.params), p.params[0], p.width, p.height]
        for c, p in zip(cameras, flat, strict=True)
    ]
    said = subprocess.run(
        [sys.executable, "-c", PYCOLMAP],
        input=json.dumps(asked),
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    for seed, (camera, pinhole, seen) in enumerate(zip(cameras, flat, json.loads(said.stdout), strict=True)):
        picture, at = photo(seed), np.array(seen)
        assert (at > -0.5).all()  # nothing blank: every pixel was seen by the photo
        assert (at < np.array(SIZE) + 0.5).all()
        for channel in range(3):
            expected = map_coordinates(
                picture[..., channel].astype(float), (at - 0.5)[:, ::-1].T, order=1, mode="nearest"
            )
            got = undistorted(picture, camera, pinhole)[..., channel].ravel()
            np.testing.assert_allclose(got, expected, atol=0.51, err_msg=camera.model)


@pytest.mark.parametrize("model", sorted(MODEL_PARAMETERS))
def test_the_picture_is_centred_as_large_as_can_be_and_never_blank(model):
    for seed in range(5):
        camera = random_camera(np.random.default_rng(seed), model, SIZE)
        flat = pinhole_camera(camera)
        f, fy, cx, cy = flat.params
        assert f == fy
        assert (cx, cy) == (flat.width / 2, flat.height / 2)
        x, y = np.meshgrid([0, flat.width], [0, flat.height])
        corners = np.stack([(x - cx) / f, (y - cy) / f, np.ones_like(x)], -1).reshape(-1, 3)
        seen = pixels_of_points(camera.full(), corners)
        assert (seen >= -1e-6).all()
        assert (seen <= np.array(SIZE) + 1e-6).all()
        assert flat.width > 0.75 * camera.width
        assert flat.height > 0.75 * camera.height


def test_a_camera_that_is_centred_and_pinhole_stays_and_a_blind_one_is_refused():
    plain = Camera("SIMPLE_PINHOLE", 160, 120, (150.0, 80.0, 60.0))
    assert pinhole_camera(plain) == Camera("PINHOLE", 160, 120, (150.0, 150.0, 80.0, 60.0))
    with pytest.raises(InputError) as caught:
        pinhole_camera(Camera("PINHOLE", 160, 120, (150.0, 150.0, 160.0, 60.0)))
    assert_complete(caught.value, "export_not_possible", "pinhole")


def pack_of(folder, refined, names):
    """The result with photos of these names on disk."""
    images = []
    for index, (image, name) in enumerate(zip(refined.images, names, strict=True)):
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        camera = refined.camera_of(index)
        picture = photo(index, 4 if name.endswith(".png") else 3, (camera.width, camera.height))
        Image.fromarray(picture).save(path)
        images.append(replace(image, name=name, file_name=name, path=path))
    return replace(refined, images=tuple(images))


def test_photos_model_and_bundle_agree_and_names_lead_back(tmp_path):
    names = ["a/x 1.jpg", "a/x 2.JPG", "b/y.png", "b/ü.webp", "b/z.tif"]
    refined = pack_of(tmp_path / "in", random_result(1, model="OPENCV", several=True), names)
    write_pinhole(refined, tmp_path / "out")
    found = {
        path.relative_to(tmp_path / "out").as_posix()
        for path in (tmp_path / "out").rglob("*")
        if path.is_file()
    }
    stored = ["x 1.jpg", "x 2.JPG", "y.png", "ü.png", "z.png"]
    assert found == {
        *(f"images/{name}" for name in stored),
        *(f"sparse/0/{table}.bin" for table in ("cameras", "images", "points3D")),
        *("bundle.out", "list.txt", "names.json"),
        *("transforms_nerfstudio.json", "transforms_ngp.json", "points.ply"),
    }
    assert json.loads((tmp_path / "out/names.json").read_text("utf-8")) == dict(
        zip(stored, names, strict=True)
    )
    model = read_colmap_model(tmp_path / "out/sparse/0")
    bundle, _ = bundler_cameras(tmp_path / "out/bundle.out")
    assert [image.name for image in model.images.values()] == stored
    for row, image in enumerate(model.images.values()):
        camera = model.cameras[image.camera_id]
        with Image.open(tmp_path / "out/images" / image.name) as picture:
            assert picture.size == (camera.width, camera.height)
            assert picture.mode == ("RGBA" if row == 2 else "RGB")
        # Where a point lies in the new picture is where the photo's pixel went.
        points = seen_points(refined, row)
        old = ours(refined, row, points)
        pose = refined.world_from_cam[row]
        in_cam = (points - pose[:3, 3]) @ pose[:3, :3]
        new = pixels_of_points(camera.full(), in_cam)
        np.testing.assert_allclose(
            through_bundler(bundle[row], (camera.width, camera.height), points), new, atol=1e-6
        )
        given = refined.model.images[image.id].points2d_px
        assert len(image.points2d_px) == len(given)
        assert np.isfinite(old).all()


def test_equal_names_in_two_folders_stay_apart(tmp_path):
    names = ["a/1.jpg", "b/1.jpg", "a/2.jpg", "b/2.jpg", "c/1.x.jpg"]
    refined = pack_of(tmp_path / "in", random_result(2, model="PINHOLE"), names)
    write_pinhole(refined, tmp_path / "out")
    stored = json.loads((tmp_path / "out/names.json").read_text("utf-8"))
    assert list(stored.values()) == names
    assert len({name.split(".")[0] for name in stored}) == 5
    assert not any("/" in name for name in stored)


def test_a_photo_that_needs_nothing_is_copied_to_the_bit(tmp_path):
    refined = random_result(3, model="SIMPLE_PINHOLE")
    camera = Camera("SIMPLE_PINHOLE", 64, 48, (60.0, 32.0, 24.0))
    refined = pack_of(tmp_path / "in", replace(refined, cameras=(camera,)), [f"{i}.jpg" for i in range(5)])
    write_pinhole(refined, tmp_path / "out")
    for i in range(5):
        assert (tmp_path / f"out/images/{i}.jpg").read_bytes() == (tmp_path / f"in/{i}.jpg").read_bytes()


def test_colours_at_transparent_edges_do_not_bleed():
    camera = random_camera(np.random.default_rng(0), "RADIAL", SIZE)
    picture = np.zeros((120, 160, 4), np.uint8)
    picture[:, :80] = [200, 100, 50, 255]
    picture[:, 80:] = [0, 255, 0, 0]  # green that nobody should see
    flat = undistorted(picture, camera, pinhole_camera(camera)).astype(int)
    shown = flat[..., 3] > 64
    assert np.abs(flat[shown][:, :3] - [200, 100, 50]).max() <= 1
