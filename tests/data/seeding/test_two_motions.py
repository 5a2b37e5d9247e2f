"""An object that turns before a static backdrop: two motions in a pair of photos, one of which is not the camera's."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from biresnerf.data.seeding.colmap_pairs import leave_out_still, two_motions
from biresnerf.geometry.rigid import rotation_of

pycolmap = pytest.importorskip("pycolmap")

SIZE, FOCAL = 1600, 1800.0
REQUEST = {"seed": 0, "error_scale": 1.0}


def photographed(cam_from_world: np.ndarray, x_in_world: np.ndarray) -> np.ndarray:
    x = x_in_world @ cam_from_world[:3, :3].T + cam_from_world[:3, 3]
    return FOCAL * x[:, :2] / x[:, 2:] + SIZE / 2


def cameras_around(count: int) -> list[np.ndarray]:
    poses = []
    for turn in 0.15 * np.arange(count):
        pose = np.eye(4)
        pose[:3, :3] = rotation_of(np.array([0.0, turn, 0.0]))
        pose[:3, 3] = 0, 0, 5
        poses.append(pose)
    return poses


def photographs(folder: Path, on_object: int, on_backdrop: int) -> Path:
    """A COLMAP database of three photos of an object that turns, before a backdrop that does not; all is matched."""
    rng = np.random.default_rng(0)
    x_in_world, backdrop = rng.uniform(-1, 1, (on_object, 3)), rng.uniform(0, SIZE, (on_backdrop, 2))
    path = folder / "database.db"
    with pycolmap.Database.open(path) as database:
        camera = pycolmap.Camera.create_from_model_name(0, "SIMPLE_PINHOLE", FOCAL, SIZE, SIZE)
        camera.has_prior_focal_length = True
        camera_id = database.write_camera(camera)
        images = []
        for number, pose in enumerate(cameras_around(3)):
            images.append(database.write_image(pycolmap.Image(name=f"{number}.png", camera_id=camera_id)))
            seen = np.concatenate((photographed(pose, x_in_world), backdrop))
            database.write_keypoints(images[-1], (seen + rng.normal(0, 0.3, seen.shape)).astype(np.float32))
        every = np.repeat(np.arange(on_object + on_backdrop, dtype=np.uint32)[:, None], 2, 1)
        for a, b in ((0, 1), (0, 2), (1, 2)):
            database.write_matches(images[a], images[b], every)
    pycolmap.geometric_verification(path)
    return path


def matched(path: Path) -> list[np.ndarray]:
    with pycolmap.Database.open(path) as database:
        return [np.asarray(found.inlier_matches)[:, 0] for found in database.read_two_view_geometries()[1]]


@pytest.mark.parametrize(("on_object", "on_backdrop"), [(300, 40), (60, 300)])
def test_matches_of_a_still_backdrop_are_left_out_and_those_of_the_object_stay(
    tmp_path, on_object, on_backdrop
):
    path = photographs(tmp_path, on_object, on_backdrop)
    assert leave_out_still(REQUEST, path)
    for features in matched(path):
        assert (features < on_object).mean() > 0.99
        assert (features < on_object).sum() > 0.9 * on_object


def test_matches_of_a_scene_without_a_backdrop_stay_as_they_are(tmp_path):
    path = photographs(tmp_path, 300, 0)
    before = matched(path)
    assert not leave_out_still(REQUEST, path)
    assert all(np.array_equal(a, b) for a, b in zip(before, matched(path), strict=True))


def test_points_about_the_axis_of_a_turn_are_no_second_motion():
    """A camera that rolls moves all points but those about its axis: there, as many as the area says."""
    xy = np.random.default_rng(1).uniform(-800, 800, (200_000, 2))
    turned = xy @ rotation_of(np.array([0.0, 0.0, 0.1]))[:2, :2].T
    assert (np.linalg.norm(xy - turned, axis=1) < 4 / 3).sum() > 8
    assert not two_motions(xy, turned, 4.0)
    copies = xy + np.random.default_rng(2).normal(0, 0.3, xy.shape)
    assert not two_motions(xy, copies, 4.0), "photos of one pose have no second motion"
