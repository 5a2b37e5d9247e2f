"""Who sees what others see: exact on cameras and points placed by hand."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from biresnerf.data.model.dataset import Camera
from biresnerf.data.synthetic.scene import synthetic_cameras
from biresnerf.geometry.camera.camera import Intrinsics
from biresnerf.refine.scene.shared_views import shared_shares

LENS = Camera("SIMPLE_PINHOLE", 20, 20, (20.0, 10.0, 10.0))  # half a unit to each side at a distance of one


def shares(poses: np.ndarray, points: torch.Tensor, seer: list[int], lens: Camera = LENS) -> list[float]:
    intrinsics = Intrinsics.from_cameras([lens] * len(poses))
    unit_from_cam = torch.from_numpy(poses[:, :3]).float()
    return shared_shares(points, torch.tensor(seer), unit_from_cam, intrinsics).tolist()


def side_by_side(count: int) -> np.ndarray:
    """Cameras at (0, 0, 0), (1, 0, 0), ... that look along z."""
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 0, 3] = np.arange(count)
    return poses


def test_a_point_counts_once_two_others_have_it_in_view():
    far = torch.tensor([[[1.0, 0.0, 10.0]]])  # in view of all
    near = torch.tensor([[[1.0, 0.0, 1.0]]])  # of the one above it alone
    behind = torch.tensor([[[1.0, 0.0, -10.0]]])
    assert shares(side_by_side(3), far, [0]) == [1]
    assert shares(side_by_side(2), far, [0]) == [0]  # one witness is too few, and its own view is none
    assert shares(side_by_side(3), near, [1]) == [0]
    assert shares(side_by_side(3), behind, [0]) == [0]


def test_shares_are_of_each_seers_own_points():
    points = torch.tensor([[[1.0, 0, 10], [1, 0, 1]], [[1, 0, 10], [1, 0, 12]], [[1, 0, 1], [1, 0, -3]]])
    assert shares(side_by_side(4), points, [0, 2, 2]) == [0.5, 1, 0]


def test_a_camera_turned_away_shares_nothing_and_those_about_a_scene_all():
    poses = synthetic_cameras(12, seed=1)
    poses[4] = poses[4] @ np.diag([-1.0, 1, -1, 1])
    ahead = torch.from_numpy(poses[:, :3, 3] + 4 * poses[:, :3, 2]).float()[:, None]
    assert shares(poses, ahead, list(range(12))) == [0.0 if i == 4 else 1.0 for i in range(12)]


def test_fisheyes_share_what_lies_beside_and_behind_them():
    lens = Camera("SIMPLE_RADIAL_FISHEYE", 20, 20, (5.0, 10.0, 10.0, 0.0))  # 115 degrees to each side
    beside = torch.tensor([[[50.0, 0.0, 0.0], [50.0, 0.0, -10.0], [50.0, 0.0, -100.0]]])
    assert shares(side_by_side(3), beside, [0], lens) == [pytest.approx(2 / 3)]
