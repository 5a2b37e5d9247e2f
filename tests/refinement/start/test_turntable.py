"""Poses from scratch for an object that turns once before the camera: direction, elevation, uneven steps."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from biresnerf.data.formats.read_dataset import read_dataset
from biresnerf.data.photos.images import ImageSet, load_images
from biresnerf.data.seeding.initial_poses import InitialPoses
from biresnerf.data.seeding.seed_poses import seed_poses
from biresnerf.data.synthetic.captures import turntable_cameras
from biresnerf.data.synthetic.scene import render_synthetic, write_blender_set
from biresnerf.errors import InputError, Interrupted
from biresnerf.geometry.pose_error import rotation_between_deg
from biresnerf.geometry.similarity import align_by_spread
from biresnerf.geometry.turntable import Ring
from biresnerf.refinement.optimise.method_changes import changed
from biresnerf.refinement.optimise.methods import BIRESNERF
from biresnerf.refinement.start import turntable
from biresnerf.refinement.start.ring_order import find_ring
from biresnerf.refinement.start.turntable import Tried, at_elevation, likeliest_elevation, start_on_turntable
from tests.refinement.tiny_scene import photos_set, tiny_recipe

VIEWS, SIZE = 24, 32


def turned_set(folder: Path, *, backwards: bool) -> tuple[InitialPoses, ImageSet, np.ndarray]:
    """The synthetic scene on a turntable: where its cameras begin, its photos, and its true poses."""
    poses = turntable_cameras(VIEWS, uneven=0.2, seed=1)
    if backwards:
        poses = poses[::-1]
    dataset = read_dataset(
        write_blender_set(folder, poses, (render_synthetic(p, SIZE, 3)[0] for p in poses), "dome")
    )
    seeding = seed_poses(dataset, "turntable")
    return seeding.candidates[0], load_images(seeding.dataset, SIZE), dataset.world_from_cam


@pytest.mark.slow
def test_a_turning_scene_is_told_from_its_mirror_image_and_its_poses_approached(tmp_path):
    recipe = tiny_recipe(changed(BIRESNERF, {"start.elevations_deg": (0.0, 30.0, 60.0)}))
    even, images, true = turned_set(tmp_path / "set", backwards=True)
    found = start_on_turntable(even, images, recipe, lambda: False)

    def error_deg(poses: np.ndarray) -> float:
        aligned = align_by_spread(poses, true).apply_to_poses(poses)
        return float(rotation_between_deg(aligned, true).mean())

    assert error_deg(found.world_from_cam) < 4
    assert error_deg(even.world_from_cam) > 20
    better, other = found.trials
    assert better.psnr > other.psnr + 0.3
    assert set(found.sources) == {"turntable"}


def test_a_background_that_stands_still_is_refused_and_said_to_be_in_the_way():
    rng = np.random.default_rng(0)
    behind = rng.integers(0, 256, (32, 32, 3), dtype=np.uint8)
    photos = []
    for _ in range(12):
        photo = behind.copy()
        photo[8:24, 8:24] = rng.integers(0, 256, (16, 16, 3), dtype=np.uint8)
        photos.append(photo)
    images = photos_set(photos)
    even = InitialPoses(turntable_cameras(12, 0.0, 0), "turntable", ("turntable",) * 12)
    with pytest.raises(InputError) as caught:
        start_on_turntable(even, images, tiny_recipe(), lambda: False)
    assert caught.value.code == "insufficient_overlap"
    assert "background" in caught.value.detail
    assert "mask" in (caught.value.hint or "")
    masked = replace(images, counts=np.ones(len(images.pixels), dtype=np.bool_))
    with pytest.raises(Interrupted):
        start_on_turntable(even, masked, tiny_recipe(), lambda: True)


def test_the_likeliest_elevation_is_the_top_of_a_parabola_through_uneven_tries():
    level = Ring.level(torch.zeros(3))
    tried = [Tried(at_elevation(level, e), 30 - 7 * (e - 0.37) ** 2) for e in (0.9, -0.5, 0.1, 0.5)]
    assert likeliest_elevation(tried) == pytest.approx(0.37, abs=1e-6)
    assert likeliest_elevation(tried[:1]) == pytest.approx(0.9)


def test_rings_to_try_turn_both_ways_from_where_the_axis_is_seen(tmp_path):
    even, images, _ = turned_set(tmp_path / "set", backwards=False)
    elevations = BIRESNERF.start.elevations_deg
    forth, back = turntable.rings_to_try(images, find_ring(images, np.arange(VIEWS)), elevations)
    step = 2 * math.pi / VIEWS
    for ring, other in zip(forth, back, strict=True):
        np.testing.assert_allclose(ring.azimuth.numpy(), step * np.arange(VIEWS), atol=1e-5)
        np.testing.assert_allclose(other.azimuth.numpy(), -ring.azimuth.numpy())
        assert abs(float(ring.pan)) < 0.03
    assert [round(math.degrees(float(ring.elevation))) for ring in forth] == list(elevations)
    np.testing.assert_allclose(even.world_from_cam, forth[1].matrices(), atol=1e-6)
