"""Suspicious photos are flagged: blurred, differently exposed, or moved far more than the others."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from biresnerf.refinement.numbers.choosing import VerdictNumbers
from biresnerf.refinement.verdict.image_flags import blurred, exposure_off, moved_far, sharpness
from tests.refinement.tiny_scene import tiny_set

NUMBERS = VerdictNumbers()

VIEWS = 14


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return tiny_set(tmp_path_factory.mktemp("scene"), views=VIEWS, size=24)


def test_a_blurred_photo_tells_on_itself(scene):
    dataset, images = scene
    spoilt = images.pixels.copy()
    rows = slice(int(images.offsets[5]), int(images.offsets[6]))
    photo = images.image(5).astype(float)
    for _ in range(3):
        photo = sum(np.roll(photo, shift, (0, 1)) for shift in ((0, 0), (0, 1), (1, 0), (1, 1))) / 4
    spoilt[rows] = photo.reshape(-1, 3).astype(np.uint8)
    poses = dataset.world_from_cam
    assert not blurred(sharpness(images, poses), NUMBERS).any()
    assert np.flatnonzero(blurred(sharpness(replace(images, pixels=spoilt), poses), NUMBERS)).tolist() == [5]


def test_outliers_in_exposure_and_motion_are_flagged_and_they_alone():
    gain = np.exp(np.random.default_rng(1).normal(0, 0.02, 20))
    assert not exposure_off(gain, NUMBERS).any()
    gain[[4, 9]] = 0.7, np.nan
    assert np.flatnonzero(exposure_off(gain, NUMBERS)).tolist() == [4]
    assert not exposure_off(np.full(5, np.nan), NUMBERS).any()
    turned, shifted = np.full(20, 0.5), np.full(20, 0.01)
    assert not moved_far(turned, shifted, 4.0, NUMBERS).any()
    turned[3], shifted[8] = 6.0, 0.5
    assert np.flatnonzero(moved_far(turned, shifted, 4.0, NUMBERS)).tolist() == [3, 8]
