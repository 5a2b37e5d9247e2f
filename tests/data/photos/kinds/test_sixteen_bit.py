"""Grey photos of 16 bits: a set with a narrow range is stretched to full contrast, all photos alike."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.photos.alike.image_likeness import thumbnails
from biresnerf.data.photos.images import load_images
from biresnerf.data.seeding.map_images import lay_out
from tests.data.scenes import HEIGHT, WIDTH, nerfstudio_scene, save


def _set(folder: Path, low: int, high: int, suffix: str = ".png") -> list[np.ndarray]:
    """Four photos of values from ``low`` to ``high``; the second uses the lower half alone."""
    document = nerfstudio_scene(folder)
    values = []
    for number, frame in enumerate(document["frames"]):
        top = (low + high) // 2 if number == 1 else high
        grey = np.random.default_rng(number).integers(low, top + 1, (HEIGHT, WIDTH)).astype(np.uint16)
        grey[0, :2] = low, top
        frame["file_path"] = frame["file_path"].replace(".jpg", suffix)
        Image.fromarray(grey).save(folder / frame["file_path"])
        values.append(grey)
    save(folder, document)
    return values


@pytest.mark.parametrize("suffix", [".png", ".tif"])
@pytest.mark.parametrize(("low", "high"), [(29000, 30500), (0, 4095)])
def test_a_small_range_becomes_black_to_white_by_one_rule_for_the_set(tmp_path, suffix, low, high):
    values = _set(tmp_path, low, high, suffix)
    dataset = read_dataset(tmp_path)
    assert any("of 65535 alone" in text and text.startswith("4 photos") for text in dataset.warnings)
    black, white = dataset.frames[0].levels
    assert low <= black < low + 0.01 * (high - low)
    assert high - 0.01 * (high - low) < white <= high
    assert len({frame.levels for frame in dataset.frames}) == 1
    images = load_images(dataset)
    for index, grey in enumerate(values):
        expected = np.clip((grey.astype(float) - black) / (white - black), 0, 1) * 255
        np.testing.assert_allclose(images.image(index)[..., 0], expected, atol=0.51)
    assert images.image(1).max() < 130  # half as bright as the others, as it was taken
    np.testing.assert_allclose(thumbnails(dataset, [0]).max(), 255, atol=1)


@pytest.mark.parametrize(("low", "high"), [(0, 65535), (10000, 50000), (500, 500)])
def test_a_large_range_or_none_at_all_is_left_alone(tmp_path, low, high):
    values = _set(tmp_path, low, high)
    dataset = read_dataset(tmp_path)
    assert dataset.warnings == ()
    assert {frame.levels for frame in dataset.frames} == {None}
    np.testing.assert_allclose(load_images(dataset).image(0)[..., 0], values[0] / 257.0, atol=0.51)


def test_a_few_hot_pixels_do_not_count(tmp_path):
    document = nerfstudio_scene(tmp_path)
    for number, frame in enumerate(document["frames"]):
        grey = np.random.default_rng(number).integers(29000, 30501, (200, 250)).astype(np.uint16)
        grey[5, 5:9] = 0, 65535, 65535, 65535
        frame["file_path"] = frame["file_path"].replace(".jpg", ".png")
        Image.fromarray(grey).save(tmp_path / frame["file_path"])
    document |= {"w": 250, "h": 200, "fl_x": 200.0, "fl_y": 200.0}
    levels = read_dataset(save(tmp_path, document)).frames[0].levels
    assert levels == pytest.approx((29000, 30500), abs=5)


def test_colmap_is_given_the_stretched_photos(tmp_path):
    _set(tmp_path, 29000, 30500)
    work = tmp_path / "work"
    work.mkdir()
    dataset = read_dataset(tmp_path)
    lay_out(dataset, work)
    laid = np.asarray(Image.open(work / "photos/000000.png"))
    assert np.array_equal(laid, load_images(dataset).image(0))
