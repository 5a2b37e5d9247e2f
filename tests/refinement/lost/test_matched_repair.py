"""Repair by matches: a lost camera stands where they place it, and none is moved against its own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from biresnerf.data.points.tracks import Tracks
from biresnerf.geometry.camera.pixel_rays import pixels_of_points
from biresnerf.geometry.pose_error import rotation_between_deg
from biresnerf.refinement.lost.lost_cameras import LostCameraRepair
from biresnerf.refinement.lost.own_matches import OwnMatches
from biresnerf.refinement.optimise.joint_optimiser import JointOptimiser
from tests.refinement.tiny_scene import given_scene, tiny_optimiser, tiny_options, tiny_set

VIEWS, LOST = 10, 4


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return tiny_set(tmp_path_factory.mktemp("scene"), views=VIEWS, size=24)


def begun(scene) -> tuple[JointOptimiser, OwnMatches]:
    """An optimiser at the true poses, and matches of random points to a tenth of a pixel; each is seen by four."""
    dataset, images = scene
    rng, points = np.random.default_rng(0), 150
    point, xyz = np.repeat(np.arange(points), 4), rng.uniform(-0.5, 0.5, (points, 3))
    image = np.concatenate([np.sort(rng.choice(VIEWS, 4, replace=False)) for _ in range(points)])
    xy = np.empty((len(point), 2))
    for i, pose in enumerate(dataset.world_from_cam):
        in_cam = (xyz[point] - pose[:3, 3]) @ pose[:3, :3]
        xy[image == i] = pixels_of_points(dataset.camera_of(i).full(), in_cam)[image == i]
    tracks = Tracks.of(point, image, xy + rng.normal(0, 0.1, xy.shape))
    own = OwnMatches.of(replace(given_scene(dataset, images), tracks=tracks))
    return tiny_optimiser(dataset, images, tiny_options()), own


def away(pose: np.ndarray) -> torch.Tensor:
    """Turned half about in place."""
    return torch.from_numpy((pose @ np.diag([-1.0, 1, -1, 1]))[:3]).float()


def placed(optimiser: JointOptimiser, own: OwnMatches | None) -> list[int]:
    """The cameras that their own matches place elsewhere."""
    repair = LostCameraRepair(optimiser, own)
    repair.place_by_matches()
    return repair.repaired


def test_a_camera_that_its_matches_contradict_is_placed_by_them(scene):
    optimiser, own = begun(scene)
    truth = optimiser.poses.poses().numpy()
    optimiser.replace_pose(LOST, away(truth[LOST]))
    assert placed(optimiser, own) == [LOST]
    found = optimiser.poses.poses().numpy()
    assert rotation_between_deg(found, truth).max() < 1.5  # a pixel is two degrees wide
    assert np.linalg.norm(found[:, :3, 3] - truth[:, :3, 3], axis=1).max() < 0.1
    assert placed(optimiser, own) == []


def test_nothing_happens_without_matches(scene):
    optimiser, _ = begun(scene)
    optimiser.replace_pose(LOST, away(optimiser.poses.poses().numpy()[LOST]))
    assert placed(optimiser, None) == []


@pytest.mark.parametrize("tied", ["fixed", "of a rig"])
def test_cameras_that_cannot_move_alone_stay(scene, tied):
    optimiser, own = begun(scene)
    optimiser.replace_pose(LOST, away(optimiser.poses.poses().numpy()[LOST]))
    if tied == "fixed":
        optimiser.bodies.fixed[LOST] = True
    else:
        optimiser.bodies.of[LOST:] -= 1  # one body with the camera before it
    assert placed(optimiser, own) == []


def test_matches_object_to_poses_that_fit_them_less(scene):
    optimiser, own = begun(scene)
    truth = optimiser.poses.poses().numpy()
    assert LostCameraRepair(optimiser, own).matches_object_to(LOST, away(truth[LOST]))
    assert not LostCameraRepair(optimiser, None).matches_object_to(LOST, away(truth[LOST]))
    optimiser.replace_pose(LOST, away(truth[LOST]))
    assert not LostCameraRepair(optimiser, own).matches_object_to(
        LOST, torch.from_numpy(truth[LOST, :3]).float()
    )
