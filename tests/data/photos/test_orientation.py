"""EXIF orientation: pixels, poses and intrinsics stay together, whoever turned the photos before."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image, ImageOps

from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.photos.guessed_lens import guess_lens
from biresnerf.data.photos.image_files import FocalPlane, ImageHeader, MakerLens
from biresnerf.data.photos.images import load_images
from biresnerf.data.photos.orientation import (
    INVERSE,
    meant_orientations,
    shown_from_stored,
    turned,
    turned_header,
    turned_size,
)
from tests.data.scenes import HEIGHT, WIDTH, nerfstudio_scene, save

ORIENTATIONS = list(range(1, 9))


def _tagged(folder, orientation: int, suffix: str = ".png", **sizes: int):
    """A scene whose first photo asks to be turned; the others are as stored. Sizes go into its frame."""
    document = nerfstudio_scene(folder)
    stored = np.random.default_rng(1).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    exif = Image.Exif()
    exif[0x0112] = orientation
    Image.fromarray(stored).save(folder / f"images/x{suffix}", exif=exif)
    document["frames"][0] |= {"file_path": f"images/x{suffix}", **sizes}
    if sizes:
        document["frames"][0] |= {"fl_x": 18.0, "fl_y": 18.0, "cx": sizes["w"] / 2, "cy": sizes["h"] / 2}
    return stored, read_dataset(save(folder, document))


@pytest.mark.parametrize("orientation", ORIENTATIONS)
def test_turning_shows_a_picture_as_viewers_do(orientation):
    stored = np.random.default_rng(0).integers(0, 256, (4, 6, 3), dtype=np.uint8)
    picture = Image.fromarray(stored)
    picture.getexif()[0x0112] = orientation
    shown = np.asarray(ImageOps.exif_transpose(picture))
    assert np.array_equal(turned(stored, orientation), shown)
    assert turned_size(6, 4, orientation) == (shown.shape[1], shown.shape[0])
    assert np.array_equal(turned(turned(stored, orientation), INVERSE[orientation]), stored)


@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_the_upright_camera_sees_each_pixel_where_the_turned_picture_shows_it(orientation):
    width, height, focal, x, y = 6, 4, 5.0, 4, 1
    stored = np.zeros((height, width), dtype=np.uint8)
    stored[y, x] = 1
    shown = turned(stored, orientation)
    in_stored = np.array([(x + 0.5 - width / 2) / focal, (y + 0.5 - height / 2) / focal, 1.0])
    in_shown = shown_from_stored(orientation)[:3, :3] @ in_stored
    column, row = in_shown[:2] * focal + np.array(shown.shape[::-1]) / 2
    assert np.argwhere(shown).tolist() == [[int(row), int(column)]]


def test_the_makers_lens_of_a_stored_picture_is_not_taken_for_that_of_the_turned_one():
    measured = MakerLens(600.0, 500.0, 500.0, 30.0, -20.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    stored = ImageHeader(600, 400, orientation=6, maker_lens=measured)
    assert guess_lens(stored)[1] == "maker"
    upright, source = guess_lens(turned_header(stored, 6))
    assert (upright.full().cx, upright.full().cy, source) == (200.0, 300.0, "guessed")


@pytest.mark.parametrize("suffix", [".png", ".tif", ".webp"])
@pytest.mark.parametrize("orientation", [3, 6])
def test_poses_are_for_stored_pixels_unless_the_file_shows_otherwise(tmp_path, suffix, orientation):
    stored, dataset = _tagged(tmp_path, orientation, suffix)
    image = load_images(dataset).image(0)
    assert image.shape == stored.shape
    if suffix != ".webp":  # Pillow's default loses colours there
        assert np.array_equal(image, stored)
    assert dataset.camera_of(0).width == WIDTH
    assert any(f"x{suffix}" in note and "as stored" in note for note in dataset.warnings)


@pytest.mark.parametrize("suffix", [".png", ".tif"])
@pytest.mark.parametrize("orientation", [5, 6, 7, 8])
def test_poses_for_the_turned_picture_get_the_turned_picture(tmp_path, suffix, orientation):
    stored, dataset = _tagged(tmp_path, orientation, suffix, w=HEIGHT, h=WIDTH)
    images = load_images(dataset)
    assert np.array_equal(images.image(0), turned(stored, orientation))
    assert (dataset.camera_of(0).width, dataset.camera_of(0).height) == (HEIGHT, WIDTH)
    assert any(f"x{suffix}" in note and "turned as EXIF says" in note for note in dataset.warnings)


@pytest.mark.parametrize("mode", ["L", "RGB", "RGBA", "CMYK", "I;16"])
@pytest.mark.parametrize("compression", [None, "tiff_lzw"])
def test_a_tiff_is_taken_as_stored_whatever_its_kind(tmp_path, mode, compression):
    """Pillow turns TIFFs by itself, and gets those that it maps into memory wrong."""
    stored = np.random.default_rng(1).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    picture = Image.fromarray(stored).convert("L" if mode == "I;16" else mode)
    if mode == "I;16":
        picture = Image.fromarray(np.asarray(picture).astype(np.uint16) * 257)
    pixels = []
    for orientation in (1, 6):
        exif = Image.Exif()
        exif[0x0112] = orientation
        document = nerfstudio_scene(tmp_path)
        picture.save(tmp_path / "images/x.tif", exif=exif, compression=compression)
        document["frames"][0]["file_path"] = "images/x.tif"
        pixels.append(load_images(read_dataset(save(tmp_path, document))).image(0))
    assert np.array_equal(pixels[0], pixels[1])
    assert pixels[0].std() > 30


def test_images_alone_keep_their_stored_pixels(tmp_path):
    stored, _ = _tagged(tmp_path, 6)
    for path in (tmp_path / "transforms.json", *(tmp_path / "images").glob("*.jpg")):
        path.unlink()
    for index in range(2):
        Image.fromarray(stored).save(tmp_path / f"images/{index}.png")
    dataset = read_dataset(tmp_path)
    assert np.array_equal(load_images(dataset).image(2), stored)
    assert any("x.png" in note and "as stored" in note for note in dataset.warnings)


LANDSCAPE, PORTRAIT = (4000.0, 3000.0), (3000.0, 4000.0)


@pytest.mark.parametrize(
    ("tags", "declared", "expected"),
    [
        ([6, 1], [PORTRAIT, LANDSCAPE], [6, 1]),
        ([6, 8], [LANDSCAPE, LANDSCAPE], [1, 1]),
        ([6, 6], [(1500.0, 2000.0), (None, None)], [6, 6]),  # resized; and one like the others
        ([6, 3], [PORTRAIT, LANDSCAPE], [6, 3]),  # whoever turned the first turned the second
        ([3, 3], [LANDSCAPE, LANDSCAPE], [1, 1]),
        ([6, 6, 3], [PORTRAIT, LANDSCAPE, LANDSCAPE], [6, 1, 1]),  # they disagree: what shows nothing stays
        ([6, 1], [(None, None), LANDSCAPE], [1, 1]),
    ],
)
def test_the_declared_size_tells_which_picture_poses_mean(tags, declared, expected):
    headers = [ImageHeader(4000, 3000, tag) for tag in tags]
    assert meant_orientations(headers, declared) == expected


def test_a_turned_sensor_is_measured_along_the_turned_axes():
    header = ImageHeader(40, 30, 6, 4.0, 28.0, FocalPlane(10.0, 20.0, 80, 60))
    assert turned_header(header, 6) == ImageHeader(30, 40, 1, 4.0, 28.0, FocalPlane(20.0, 10.0, 60, 80))
    assert turned_header(header, 1) == header
