"""Photos of a camera with skew are straightened, and then fit a camera without it: pixels, masks and poses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from biresnerf.data.formats.convert import convert
from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.formats.simple.poses_json import read_poses_json
from biresnerf.data.model.dataset import Dataset
from biresnerf.data.photos.decode import decode
from biresnerf.data.photos.images import load_images
from biresnerf.data.seeding.map_images import lay_out
from biresnerf.geometry.camera.pixel_rays import rays_of_pixels
from biresnerf.geometry.pose_error import rotation_between_deg
from biresnerf.geometry.resection import resect
from tests.data.formats.simple.trajectories import NAMES, metashape_xml, truth

WIDTH, HEIGHT = 400, 320
FOCAL, CX, CY, K1 = 370.0, 5.0, -5.0, 0.05
B2 = 9.0  # moves the corners by 3.9 px


def seen(rays: np.ndarray) -> np.ndarray:
    """Colours [m, 3], 0 to 255, of smooth surroundings in directions [m, 3] of the camera."""
    x, y = (rays[:, :2] / rays[:, 2:]).T
    waves = [np.sin(40 * x + 9 * y), np.sin(11 * x - 37 * y), np.sin(29 * (x + y))]
    return 127.5 + 120 * np.stack(waves, axis=1)


def by_the_manual(in_cam: np.ndarray, b2: float) -> np.ndarray:
    """Pixels [m, 2] of points [m, 3]: Metashape's manual, appendix on camera models."""
    x, y = (in_cam[:, :2] / in_cam[:, 2:]).T
    radial = 1 + K1 * (x**2 + y**2)
    return np.stack(
        [WIDTH / 2 + CX + x * radial * FOCAL + y * radial * b2, HEIGHT / 2 + CY + y * radial * FOCAL], axis=1
    )


def rays_by_the_manual(pixels: np.ndarray, b2: float) -> np.ndarray:
    """Directions [m, 3] that `by_the_manual` brings to ``pixels``, by fixed-point iteration."""
    y = (pixels[:, 1] - HEIGHT / 2 - CY) / FOCAL
    x = (pixels[:, 0] - WIDTH / 2 - CX - y * b2) / FOCAL
    ray = np.stack([x, y, np.ones_like(x)], axis=1)
    for _ in range(60):
        radial = 1 + K1 * (ray[:, 0] ** 2 + ray[:, 1] ** 2)
        ray = np.stack([x / radial, y / radial, np.ones_like(x)], axis=1)
    return ray


def skewed_set(folder: Path, b2: float) -> Dataset:
    """Photos of those surroundings through the lens with skew, and Metashape's export beside them."""
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
    rays = rays_by_the_manual(np.stack([x.ravel(), y.ravel()], axis=1), b2)
    photo = np.rint(seen(rays)).astype(np.uint8).reshape(HEIGHT, WIDTH, 3)
    (folder / "images").mkdir(parents=True)
    for name in NAMES:
        Image.fromarray(photo).save(folder / "images" / name)
    text = metashape_xml().replace('width="20" height="16"', f'width="{WIDTH}" height="{HEIGHT}"')
    lens = f"<f>{FOCAL}</f><cx>{CX}</cx><cy>{CY}</cy><b2>{b2}</b2><k1>{K1}</k1>"
    text = text.replace("<f>18.5</f><cx>0.25</cx><cy>-0.25</cy>", lens)
    assert lens in text
    (folder / "cameras.xml").write_text(text)
    return read_dataset(folder)


@pytest.mark.parametrize("b2", [0.0, B2, -B2])
def test_a_pixel_shows_what_the_camera_without_skew_sees_there(tmp_path, b2):
    images = load_images(skewed_set(tmp_path, b2))
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
    true = seen(rays_of_pixels(images.cameras[0].full(), np.stack([x.ravel(), y.ravel()], axis=1)))
    counts = images.counts_image(0)
    wrong = np.abs(images.image(0).reshape(-1, 3) - true)
    wrong = wrong if counts is None else wrong[counts.ravel()]
    assert wrong.max() < 2  # of 255: rounding, and bilinear sampling


def test_pixels_that_would_come_from_beside_the_photo_do_not_count(tmp_path):
    counts = load_images(skewed_set(tmp_path, B2)).counts_image(0)
    moved = B2 / FOCAL * (np.arange(HEIGHT) + 0.5 - HEIGHT / 2)
    missing = (~counts).sum(axis=1)
    assert np.abs(missing - np.abs(moved)).max() <= 1
    assert [counts[0, 0], counts[0, -1], counts[-1, 0], counts[-1, -1]] == [False, True, True, False]


def test_poses_are_found_as_exactly_as_without_skew(tmp_path):
    rng = np.random.default_rng(0)
    points = rng.uniform((-2, -2, -1), (2, 2, 1), (60, 3))
    pose = np.eye(4)
    pose[:3, 3] = (0.2, -0.3, -6.0)
    errors = {}
    for b2 in (0.0, B2):
        camera = skewed_set(tmp_path / str(b2), b2).cameras[0]
        stored = by_the_manual(points - pose[:3, 3], b2)
        straight = stored - np.outer(camera.shear * (stored[:, 1] - HEIGHT / 2), [1, 0])
        for name, pixels in (("straightened", straight), ("stored", stored)):
            found = resect(points, rays_of_pixels(camera.full(), pixels), bound=0.02)
            assert found is not None
            error = np.abs(found.world_from_cam[:3, 3] - pose[:3, 3]).max()
            turn = rotation_between_deg(found.world_from_cam[None], pose[None])[0]
            errors[name, b2] = max(error, turn)
    assert errors["straightened", 0.0] < 1e-6
    assert errors["straightened", B2] < 1e-6
    assert errors["stored", B2] > 0.01


def test_a_mask_is_straightened_with_its_photo(tmp_path):
    skewed_set(tmp_path, B2)
    upright = np.full((HEIGHT, WIDTH), 255, dtype=np.uint8)
    upright[:, 200:] = 0
    (tmp_path / "masks").mkdir()
    Image.fromarray(upright).save(tmp_path / "masks" / f"{NAMES[0]}.png")
    counts = load_images(read_dataset(tmp_path)).counts_image(0)
    moved = B2 / FOCAL * (np.arange(HEIGHT) + 0.5 - HEIGHT / 2)
    last = WIDTH - 1 - np.argmax(counts[:, ::-1], axis=1)
    assert np.abs(last - (199 - moved)).max() <= 1.5


def test_the_photos_poses_are_the_files_and_the_report_says_what_was_done(tmp_path):
    dataset = skewed_set(tmp_path, B2)
    np.testing.assert_allclose(dataset.world_from_cam, truth(), atol=1e-12)
    (note,) = [text for text in dataset.warnings if "skew" in text]
    assert "3.9 px" in note
    assert not any("skew" in text for text in skewed_set(tmp_path / "none", 0.0).warnings)


def test_colmap_gets_the_straightened_photos(tmp_path):
    dataset = skewed_set(tmp_path / "set", B2)
    (tmp_path / "work").mkdir()
    asked = lay_out(dataset, tmp_path / "work")
    (photo,) = {path.name for path in Path(asked["root"]).iterdir()} & {asked["cameras"][0]["names"][0]}
    given = np.asarray(Image.open(Path(asked["root"]) / photo))
    np.testing.assert_array_equal(given, decode(dataset.frames[0], dataset.cameras[0]))
    assert not np.array_equal(given, np.asarray(Image.open(dataset.frames[0].path)))


def test_results_keep_the_skew_and_pinhole_holds_photos_that_fit(tmp_path):
    dataset = skewed_set(tmp_path / "set", B2)
    convert(dataset, ["poses", "pinhole"], tmp_path / "out", photos="none")
    document = read_poses_json(tmp_path / "out/poses.json")
    assert document.cameras[0].shear == pytest.approx(B2 / FOCAL)
    flat = read_dataset(tmp_path / "out/pinhole/transforms_nerfstudio.json")
    y, x = np.mgrid[0 : flat.cameras[0].height, 0 : flat.cameras[0].width] + 0.5
    true = seen(rays_of_pixels(flat.cameras[0].full(), np.stack([x.ravel(), y.ravel()], axis=1)))
    assert np.abs(decode(flat.frames[0], flat.cameras[0]).reshape(-1, 3) - true).max() < 4
