"""What several cameras see: where sampling may begin, and how much of a view others share."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from biresnerf.data.synthetic.scene import synthetic_cameras
from biresnerf.geometry.camera.camera import Intrinsics
from biresnerf.geometry.camera.camera_models import Camera
from biresnerf.refinement.numbers.scene import FrameNumbers
from biresnerf.refinement.scene.scene_frame import scene_frame
from biresnerf.refinement.scene.shared_views import (
    ASKED_AT_ONCE,
    MOST_ASKED,
    SPACING,
    nearest_shared,
    shared_shares,
)
from tests.refinement.tiny_scene import tiny_optimiser, tiny_options, tiny_set

FRAME = FrameNumbers()

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


def test_many_cameras_asked_some_at_a_time_say_what_all_would():
    poses = synthetic_cameras(3 * ASKED_AT_ONCE + 5, seed=2)
    points = torch.from_numpy(np.random.default_rng(0).normal(0, 4, (1, 200, 3))).float()
    last = len(poses) - 1
    others = np.delete(np.arange(len(poses)), last)
    in_cam = np.einsum("cji,cmj->cmi", poses[:, :3, :3], points.numpy() - poses[:, None, :3, 3])[others]
    xy = in_cam[..., :2] / in_cam[..., 2:]
    seen = (in_cam[..., 2] > 0) & (np.abs(xy) < 0.5).all(-1)
    expected = (seen.sum(0) >= 2).mean()
    assert 0.1 < expected < 0.9
    assert shares(poses, points, [last]) == [pytest.approx(expected)]


def test_of_a_long_row_those_near_the_points_say_what_all_would():
    points = torch.tensor([[[x, 0.0, depth]] for x in (1.0, 1500.0, 2990.0) for depth in (1.0, 10.0)])
    assert MOST_ASKED < 1000
    assert shares(side_by_side(3000), points, [1, 1, 0, 0, 2999, 2999]) == [0, 1, 0, 1, 0, 1]


def test_a_camera_turned_away_shares_nothing_and_those_about_a_scene_all():
    poses = synthetic_cameras(12, seed=1)
    poses[4] = poses[4] @ np.diag([-1.0, 1, -1, 1])
    ahead = torch.from_numpy(poses[:, :3, 3] + 4 * poses[:, :3, 2]).float()[:, None]
    assert shares(poses, ahead, list(range(12))) == [0.0 if i == 4 else 1.0 for i in range(12)]


def test_fisheyes_share_what_lies_beside_and_behind_them():
    lens = Camera("SIMPLE_RADIAL_FISHEYE", 20, 20, (5.0, 10.0, 10.0, 0.0))  # 115 degrees to each side
    beside = torch.tensor([[[50.0, 0.0, 0.0], [50.0, 0.0, -10.0], [50.0, 0.0, -100.0]]])
    assert shares(side_by_side(3), beside, [0], lens) == [pytest.approx(2 / 3)]


def arc(count: int, apart_deg: float, distance: float = 5.0) -> np.ndarray:
    """Cameras on an arc about the origin, looking at it."""
    poses = np.tile(np.eye(4), (count, 1, 1))
    for pose, angle in zip(poses, np.radians(apart_deg * np.arange(count)), strict=True):
        forward = np.array([np.sin(angle), 0, np.cos(angle)])
        pose[:3, :3] = np.stack([[np.cos(angle), 0, -np.sin(angle)], [0, 1, 0], forward], 1)
        pose[:3, 3] = -distance * forward
    return poses


def near_of(poses: np.ndarray, distance: float = 5.0) -> float:
    camera = Camera("SIMPLE_PINHOLE", 20, 20, (20.0, 10.0, 10.0))
    return nearest_shared(poses, Intrinsics.from_cameras([camera] * len(poses)), distance, FRAME)


def test_cameras_closer_together_may_see_nearer_things():
    nears = [near_of(arc(12, apart)) for apart in (1, 4, 7)]
    assert nears[0] == pytest.approx(FRAME.nearest)
    assert nears == sorted(nears)
    assert nears[2] > nears[0]


@pytest.mark.parametrize("apart", [4, 6])
def test_where_sampling_begins_most_of_a_view_is_in_two_others(apart):
    """By the geometry of the arc, in its plane: of the neighbours and theirs, two must have the point in view."""
    near = near_of(arc(60, apart))
    across = np.linspace(-0.5, 0.5, 200)  # half the angle of view is arctan 0.5

    def seen(share: float) -> float:
        x, z = 5 * share * across, np.full(200, 5 * share - 5)
        views = []
        for angle in np.radians(apart) * np.array([-2, -1, 1, 2]):
            sideways = x * np.cos(angle) - z * np.sin(angle)
            ahead = x * np.sin(angle) + z * np.cos(angle) + 5
            views.append(np.abs(sideways) < 0.5 * ahead)
        return float((np.sum(views, 0) >= 2).mean())

    assert seen(near) >= 0.75
    assert seen(near - SPACING) <= 0.85


def test_scale_and_place_do_not_matter():
    poses = arc(12, 6)
    moved = poses.copy()
    moved[:, :3, 3] = 100 * moved[:, :3, 3] + np.array([5.0, -7.0, 1e3])
    assert near_of(moved, 500.0) == near_of(poses)


def test_a_set_that_shares_little_is_sampled_from_as_near_as_ever():
    assert near_of(arc(6, 60)) == FRAME.nearest  # all around: only cameras across the scene look there


def test_noise_never_moves_it_beyond_its_bound():
    rng = np.random.default_rng(0)
    poses = arc(12, 6)
    poses[:, :3, 3] += rng.normal(0, 1.0, (12, 3))
    assert FRAME.nearest <= near_of(poses) <= FRAME.farthest


def test_open_scenes_are_sampled_from_there_on_and_others_as_before(tmp_path):
    dataset, images = tiny_set(tmp_path)
    assert scene_frame(dataset.world_from_cam, images, FRAME).near == 0.0
    opened = replace(images, alpha=None, background=None)
    optimiser = tiny_optimiser(dataset, opened, tiny_options())
    optimiser.frame = replace(optimiser.frame, near=0.45)
    optimiser.step_index, optimiser.switch = 39, 20
    assert optimiser.marching(0.01).near == pytest.approx(0.45 * optimiser.frame.distance)
    both = scene_frame(np.concatenate([dataset.world_from_cam] * 2), opened, FRAME)
    assert both.near == scene_frame(dataset.world_from_cam, opened, FRAME).near
