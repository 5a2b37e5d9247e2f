"""How many features are extracted, and that photos are numbered in order with any number of threads."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.seeding.colmap_child import extract_features, import_images
from biresnerf.data.seeding.colmap_pairs import likeliest_pairs
from biresnerf.data.seeding.map_images import COMPARISONS, MOST_FEATURES, thoroughness
from tests.data.scenes import nerfstudio_scene, save


@pytest.fixture(name="dataset")
def posed_set(tmp_path):
    return read_dataset(save(tmp_path, nerfstudio_scene(tmp_path)))


def test_matching_takes_the_same_however_many_pairs_there_are(dataset):
    assert thoroughness(dataset, "full", 10)["most_features"] == MOST_FEATURES
    compared = thoroughness(dataset, "full", 2000)["most_features"] ** 2 * 2000
    assert compared == pytest.approx(COMPARISONS, rel=0.01)


def test_large_photos_get_plain_features_and_small_ones_thorough_ones(dataset):
    camera = dataset.cameras[0]
    for width, thorough in ((200, True), (399, True), (400, False), (2000, False)):
        sized = replace(dataset, cameras=(camera.resized(width, width // 2),))
        assert thoroughness(sized, "full", 10)["thorough"] is thorough
        assert not thoroughness(sized, "low", 10)["thorough"]


def test_photos_are_numbered_in_their_order_however_long_each_takes(tmp_path):
    pycolmap = pytest.importorskip("pycolmap")
    rng = np.random.default_rng(0)
    names = [f"{i}.png" for i in range(4)]
    noise = Image.fromarray(rng.integers(0, 255, (100, 100, 3), dtype=np.uint8))
    noise.resize((600, 600), Image.Resampling.BICUBIC).save(tmp_path / names[0])  # full of features
    for name in names[1:]:
        Image.new("RGB", (600, 600)).save(tmp_path / name)
    camera = {"names": names, "model": "SIMPLE_PINHOLE", "params": None}
    options = pycolmap.FeatureExtractionOptions()
    options.num_threads = 2
    database = Path(tmp_path, "database.db")
    asked = {"cameras": [camera], "masks": None}
    import_images(asked, database, tmp_path)
    extract_features(asked, database, tmp_path, options)
    opened = pycolmap.Database.open(database)
    assert [image.name for image in sorted(opened.read_all_images(), key=lambda i: i.image_id)] == names
    opened.close()


@pytest.fixture
def strip(tmp_path):
    """The features of photos along a strip of texture, in an order of names that is not theirs; their places."""
    pycolmap = pytest.importorskip("pycolmap")
    noise = np.random.default_rng(3).integers(0, 255, (60, 320, 3), dtype=np.uint8)
    texture = np.asarray(Image.fromarray(noise).resize((1280, 240), Image.Resampling.BICUBIC))
    places = [3, 0, 5, 1, 4, 2]
    names = [f"{i}.png" for i in range(len(places))]
    for name, place in zip(names, places, strict=True):
        Image.fromarray(texture[:, 160 * place : 160 * place + 320]).save(tmp_path / name)
    camera = {"names": names, "model": "SIMPLE_PINHOLE", "params": None}
    database = tmp_path / "database.db"
    options = pycolmap.FeatureExtractionOptions()
    asked = {"cameras": [camera], "masks": None}
    import_images(asked, database, tmp_path)
    extract_features(asked, database, tmp_path, options)
    return database, dict(zip(names, places, strict=True))


def test_the_likeliest_pairs_are_those_that_show_the_same_wherever_their_poses_are(strip):
    database, place = strip
    pairs = likeliest_pairs(database, None, 1)
    assert len(pairs) < len(place)
    assert all(abs(place[a] - place[b]) == 1 for a, b in pairs)
    assert {name for pair in pairs for name in pair} == set(place)


def test_only_pairs_that_may_be_are_chosen_among_and_enough_choices_take_them_all(strip):
    database, place = strip
    among = [("0.png", "2.png"), ("1.png", "3.png"), ("4.png", "5.png")]
    assert likeliest_pairs(database, among, 1) == among
    assert len(likeliest_pairs(database, None, 5)) == len(place) * (len(place) - 1) // 2
