"""Distances of some images at a time are those of all pairs at once, and never stand in memory together."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest

from biresnerf.data.model import image_distances
from biresnerf.data.model.image_distances import (
    distances_in_order,
    nearest_pairs,
    pose_distances,
    typical_distance,
)
from biresnerf.geometry.focus import focus_point
from tests.data.scenes import arc_poses

IMAGES = 700  # more than are looked at together


@pytest.fixture(scope="module")
def poses() -> np.ndarray:
    """In no order, and no two equally far from a third."""
    rng = np.random.default_rng(1)
    poses = arc_poses(IMAGES)[rng.permutation(IMAGES)]
    poses[:, :3, 3] += rng.normal(0, 0.02, (IMAGES, 3))
    return poses


@pytest.fixture(scope="module")
def apart(poses: np.ndarray) -> np.ndarray:
    """All pairs at once, by the definition."""
    centres = poses[:, :3, 3] / focus_point(poses).mean_distance
    axes = poses[:, :3, 2]
    return sum(np.linalg.norm(each[:, None] - each[None], axis=2) for each in (centres, axes))


def test_distances_are_those_of_centres_and_viewing_axes(poses, apart):
    some = np.array([3, 650, 12])
    found = pose_distances(poses)(some, np.arange(IMAGES))
    np.testing.assert_allclose(found, apart[some], atol=1e-9)


def test_neighbours_in_order_and_what_is_typical_are_those_of_all_pairs(poses, apart):
    some = pose_distances(poses)
    np.testing.assert_allclose(distances_in_order(some, IMAGES), np.diagonal(apart, 1), atol=1e-9)
    assert typical_distance(some, IMAGES) == pytest.approx(np.median(apart[np.triu_indices(IMAGES, 1)]))


def test_of_thousands_an_even_choice_says_what_is_typical(poses, apart, monkeypatch):
    monkeypatch.setattr(image_distances, "_TYPICAL", 200)
    found = typical_distance(pose_distances(poses), IMAGES)
    assert found == pytest.approx(np.median(apart[np.triu_indices(IMAGES, 1)]), rel=0.05)


def test_each_image_is_paired_with_its_nearest(poses, apart):
    found = nearest_pairs(pose_distances(poses), IMAGES, 3)
    np.fill_diagonal(apart := apart.copy(), np.inf)
    for image in range(IMAGES):
        others = {b if a == image else a for a, b in found if image in (a, b)}
        third = np.sort(apart[image])[2]
        assert {*np.flatnonzero(apart[image] <= third + 1e-12)} <= others
    assert len(found) <= 3 * IMAGES


def test_pairs_of_thousands_take_no_memory_for_each_two():
    poses = arc_poses(4000)
    tracemalloc.start()
    try:
        nearest_pairs(pose_distances(poses), len(poses), 2)
        assert tracemalloc.get_traced_memory()[1] < len(poses) ** 2 * 8 / 2  # all distances once: 128 MB
    finally:
        tracemalloc.stop()
