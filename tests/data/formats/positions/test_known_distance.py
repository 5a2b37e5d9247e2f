"""A measured distance gives metres per unit, or is refused before anything takes time."""

from __future__ import annotations

import numpy as np
import pytest

from biresnerf.data.formats.positions.known_distance import KnownDistance
from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.errors import InputError
from tests.data.scenes import assert_complete, nerfstudio_scene, save


@pytest.fixture
def dataset(tmp_path):
    save(tmp_path, nerfstudio_scene(tmp_path, 4))
    return read_dataset(tmp_path)


@pytest.mark.parametrize(
    ("text", "units"),
    [
        ("images/000.jpg, images/002.jpg, 6", 4.0),
        ("0 0 0, 0 3 4, 6", 5.0),
        ("images/002.jpg,4 3 0, 6", 3.0),
    ],
)
def test_the_scale_is_metres_over_the_distance_of_the_returned_poses(dataset, text, units):
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[2, :3, 3] = 4, 0, 0
    found = KnownDistance.of(text, dataset).scale(poses)
    assert found.metres_per_unit == pytest.approx(6 / units)
    assert found.metres == 6


def test_two_cameras_at_one_place_give_no_scale_and_no_option_no_distance(dataset):
    same = np.tile(np.eye(4), (4, 1, 1))
    assert KnownDistance.of("images/000.jpg, images/001.jpg, 1", dataset).scale(same) is None
    assert KnownDistance.of(" ", dataset) is None


@pytest.mark.parametrize(
    "text",
    ["images/000.jpg, images/009.jpg, 1", "images/000.jpg, 1", "a", "images/000.jpg, images/001.jpg, -1",
     "images/000.jpg, images/001.jpg, far", "images/000.jpg, images/000.jpg, 1", "0 0, 1 1 1, 2", "nan 0 0, 1 1 1, 2"],
)  # fmt: skip
def test_what_is_no_distance_is_refused(dataset, text):
    with pytest.raises(InputError) as caught:
        KnownDistance.of(text, dataset)
    assert_complete(caught.value, "known_distance_invalid", "known_distance")
