"""Models from matches, moved into the frame of given poses: which of their cameras are trusted."""

from __future__ import annotations

import numpy as np
import pytest

from biresnerf.data.model.image_distances import nearest_pairs, pose_distances
from biresnerf.data.seeding.map_images import MappedModel
from biresnerf.data.seeding.match_poses import STRAY_SHARE, carry_model
from biresnerf.geometry.focus import focus_point
from biresnerf.geometry.perturb import perturb_poses
from biresnerf.geometry.similarity import Similarity
from tests.data.scenes import arc_poses

VIEWS = 10
TRUTH = arc_poses(VIEWS)
NOISY = perturb_poses(TRUTH, 0.1, seed=2)
ALL = np.ones(VIEWS, dtype=bool)


def model(*, turned: tuple[int, ...] = ()) -> MappedModel:
    """The true rig, in a frame of its own, with some cameras turned about."""
    poses = TRUTH.copy()
    for i in turned:
        poses[i, :3, :3] = poses[i, :3, :3] @ np.diag([-1.0, 1, -1])
    moved = Similarity(0.2, np.diag([1.0, -1, -1]), np.array([3.0, 4, 5])).apply_to_poses(poses)
    return MappedModel("global", np.arange(VIEWS), moved, {}, 100, 300, 0.5)


def test_a_camera_that_strays_alone_is_not_believed():
    carried = carry_model(model(turned=(3,)), NOISY, ALL)
    assert carried is not None
    assert np.flatnonzero(~carried.placed).tolist() == [3]
    np.testing.assert_array_equal(carried.world_from_cam[3], NOISY[3])


def test_a_camera_whose_given_position_alone_is_far_off_is_believed_within_reason():
    off = np.linalg.norm(NOISY[:, :3, 3] - TRUTH[:, :3, 3], axis=1)
    for medians, believed in ((5.0, True), (20.0, False)):
        given = NOISY.copy()
        given[3, :3, 3] = TRUTH[3, :3, 3] + [0, medians * np.median(off), 0]
        carried = carry_model(model(), given, ALL)
        assert carried is not None
        assert np.flatnonzero(~carried.placed).tolist() == ([] if believed else [3])


@pytest.mark.parametrize("unit", [0.001, 1.0, 1000.0])
def test_which_cameras_stray_does_not_depend_on_the_unit_of_the_given_poses(unit):
    given = TRUTH.copy()
    distance = focus_point(given).mean_distance
    given[3, 1, 3] += 0.6 * STRAY_SHARE * distance
    given[6, 1, 3] += 3 * STRAY_SHARE * distance
    in_unit = Similarity(unit, np.eye(3), np.zeros(3)).apply_to_poses(given)
    carried = carry_model(model(), in_unit, ALL)
    assert carried is not None
    assert np.flatnonzero(~carried.placed).tolist() == [6]


def test_a_model_with_many_strays_is_not_offered():
    assert carry_model(model(turned=(1, 4, 8)), NOISY, ALL) is None


def test_two_given_poses_tie_a_model_to_their_frame():
    posed = np.zeros(VIEWS, dtype=bool)
    posed[[2, 6]] = True
    carried = carry_model(model(), TRUTH, posed)
    assert carried is not None
    np.testing.assert_allclose(carried.world_from_cam, TRUTH, atol=1e-6)
    assert carry_model(model(), TRUTH, np.zeros(VIEWS, dtype=bool)) is None


def test_many_images_are_matched_with_those_that_see_nearly_the_same():
    turn = np.linspace(0, 2 * np.pi, 8, endpoint=False)
    poses = np.tile(np.eye(4), (8, 1, 1))
    for pose, angle in zip(poses, turn, strict=True):
        forward = -np.array([np.cos(angle), 0, np.sin(angle)])
        down = np.array([0.0, 1, 0])
        pose[:3, :3] = np.stack([np.cross(down, forward), down, forward], 1)
        pose[:3, 3] = -4 * forward
    ring = {tuple(sorted((i, (i + 1) % 8))) for i in range(8)}
    assert nearest_pairs(pose_distances(poses), 8, 2) == ring
