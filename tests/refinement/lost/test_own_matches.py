"""A lost camera's own matches identify it and place it; where they cannot, nothing is changed."""

from __future__ import annotations

import numpy as np
import pytest

from biresnerf.data.points.tracks import Tracks
from biresnerf.geometry.camera.camera_models import Camera
from biresnerf.geometry.camera.pixel_rays import pixels_of_points
from biresnerf.geometry.epipolar import epipolar_angles
from biresnerf.geometry.perturb import perturb_poses
from biresnerf.geometry.pose_error import rotation_between_deg
from biresnerf.refinement.lost.own_matches import LEAST_PAIRS, OwnMatches, contradicted
from biresnerf.refinement.numbers.lost import LostNumbers
from tests.data.formats.random_sets import random_poses

NUMBERS = LostNumbers()
CAMERA = Camera("SIMPLE_RADIAL", 640, 480, (600.0, 320.0, 240.0, 0.02))


def rig(
    seed: int, cameras: int = 12, points: int = 200, noise_px: float = 0.3, wrong: float = 0.0
) -> tuple[np.ndarray, OwnMatches]:
    """True poses about random points, and the matches: each point is seen by four; some observations are wrong."""
    rng = np.random.default_rng(seed)
    poses, xyz = random_poses(rng, cameras), rng.uniform(-0.6, 0.6, (points, 3))
    image = np.concatenate([np.sort(rng.choice(cameras, 4, replace=False)) for _ in range(points)])
    point = np.repeat(np.arange(points), 4)
    in_cam = np.einsum("mji,mj->mi", poses[image, :3, :3], xyz[point] - poses[image, :3, 3])
    xy = pixels_of_points(CAMERA.full(), in_cam) + rng.normal(0, noise_px, (len(image), 2))
    stray = rng.random(len(image)) < wrong
    xy[stray] = rng.uniform(0, 480, (stray.sum(), 2))
    return poses, OwnMatches(Tracks.of(point, image, xy), [CAMERA] * cameras)


def without(poses: np.ndarray, camera: int, seed: int) -> np.ndarray:
    """The poses, with one camera somewhere else."""
    lost = poses.copy()
    lost[camera] = random_poses(np.random.default_rng(seed + 100), 1)[0]
    return lost


@pytest.mark.parametrize("seed", range(4))
def test_the_matches_of_a_lost_camera_name_it_alone_and_bring_it_back(seed):
    poses, own = rig(seed, wrong=0.15)
    lost = without(poses, 3, seed)
    wrong = contradicted(own.errors_px(lost), NUMBERS)
    assert np.flatnonzero(wrong).tolist() == [3]
    found = own.placed(3, lost, ~wrong, NUMBERS)
    assert rotation_between_deg(found[:3, :3], poses[3, :3, :3]) < 0.5
    assert np.linalg.norm(found[:3, 3] - poses[3, :3, 3]) < 0.03


def test_it_is_brought_back_to_where_the_others_are_with_their_own_errors():
    poses, own = rig(5)
    near = perturb_poses(poses, 0.003, seed=1)
    lost = without(near, 7, 5)
    found = own.placed(7, lost, np.arange(12) != 7, NUMBERS)
    assert rotation_between_deg(found[:3, :3], poses[7, :3, :3]) < 1.5


def test_true_poses_are_contradicted_nowhere_and_nothing_better_is_found():
    poses, own = rig(6, wrong=0.2)
    errors = own.errors_px(poses)
    assert not contradicted(errors, NUMBERS).any()
    assert errors.max() < 2.0
    found = own.placed(2, poses, np.ones(12, bool), NUMBERS)
    assert found is None or rotation_between_deg(found[:3, :3], poses[2, :3, :3]) < 0.3


def test_too_few_matches_or_wrong_ones_or_no_trusted_cameras_place_nothing():
    poses, own = rig(7, points=6)
    assert own.placed(0, poses, np.ones(12, bool), NUMBERS) is None
    poses, own = rig(8, wrong=1.0)
    assert own.placed(0, poses, np.ones(12, bool), NUMBERS) is None
    poses, own = rig(9)
    assert own.placed(0, poses, np.zeros(12, bool), NUMBERS) is None
    together = np.repeat(poses[:1], 12, axis=0)  # no parallax
    assert own.placed(0, together, np.ones(12, bool), NUMBERS) is None
    assert not contradicted(own.errors_px(together), NUMBERS).any()


def test_observations_that_were_left_out_place_no_camera():
    poses, own = rig(11)
    lost, trusted = without(poses, 4, 11), np.arange(12) != 4
    tracks = own.tracks
    judging = tracks.left_out()[tracks.point] & (tracks.image == 4)
    assert judging.sum() > 5
    moved = tracks.xy + 40.0 * judging[:, None]
    changed = OwnMatches(Tracks.of(tracks.point, tracks.image, moved), [CAMERA] * 12)
    np.testing.assert_array_equal(
        changed.placed(4, lost, trusted, NUMBERS), own.placed(4, lost, trusted, NUMBERS)
    )


def test_each_cameras_error_is_the_median_over_its_own_pairs():
    poses, own = rig(10, cameras=9, points=31, wrong=0.3)
    one, other = own.tracks.pairs()
    a, b = own.tracks.image[one], own.tracks.image[other]
    errors = epipolar_angles(poses, a, b, own.rays[one], own.rays[other])
    errors *= (own.focal_px[a] + own.focal_px[b]) / 2
    found = own.errors_px(poses)
    for camera in range(9):
        mine = errors[(a == camera) | (b == camera)]
        assert found[camera] == np.median(mine) if len(mine) >= LEAST_PAIRS else np.isnan(found[camera])
