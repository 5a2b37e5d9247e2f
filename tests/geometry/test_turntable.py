"""A ring of cameras before a turning table: where they stand, what they see of the axis, how photos lie."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from biresnerf.geometry.level_ring import level_ring, order_on_ring
from biresnerf.geometry.turntable import Ring

AZIMUTH = torch.tensor([0.0, 0.4, 2.0, 3.5, 5.1], dtype=torch.float64)


def ring(elevation: float = 0.0, pan: float = 0.0, roll: float = 0.0, quarters: int = 0) -> Ring:
    angles = [torch.tensor(angle, dtype=torch.float64) for angle in (elevation, pan, roll)]
    return Ring(AZIMUTH, *angles, torch.full((len(AZIMUTH),), quarters))


def seen(world_from_cam: np.ndarray, point: list[float]) -> np.ndarray:
    """Where cameras see a point, as x/z and y/z [n, 2]."""
    in_cam = np.einsum("nji,nj->ni", world_from_cam[:, :3, :3], np.array(point) - world_from_cam[:, :3, 3])
    assert (in_cam[:, 2] > 0).all()
    return in_cam[:, :2] / in_cam[:, 2:]


def test_without_pan_and_roll_it_is_a_level_ring():
    np.testing.assert_allclose(ring(0.3).matrices(), level_ring(AZIMUTH.numpy(), 0.3), atol=1e-12)


def test_a_turned_camera_is_the_first_one_turned_about_the_axis_the_other_way():
    poses = ring(0.3, 0.1, 0.05).matrices()
    c, s = np.cos(2.0), np.sin(2.0)
    np.testing.assert_allclose(
        poses[2, :3], np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ poses[0, :3], atol=1e-12
    )
    np.testing.assert_allclose(np.linalg.det(poses[:, :3, :3]), 1)
    np.testing.assert_allclose(np.linalg.norm(poses[:, :3, 3], axis=1), 1)


def test_upright_cameras_see_the_origin_in_their_middle_and_what_is_above_it_above():
    poses = ring(elevation=0.4).matrices()
    assert poses[:, 2, 3] == pytest.approx(np.sin(0.4))
    np.testing.assert_allclose(seen(poses, [0, 0, 0]), 0, atol=1e-12)
    above = seen(poses, [0, 0, 0.2])
    np.testing.assert_allclose(above[:, 0], 0, atol=1e-12)
    assert (above[:, 1] < -0.1).all()


def test_a_pan_shows_the_axis_to_the_right():
    np.testing.assert_allclose(
        seen(ring(0.4, pan=0.1).matrices(), [0, 0, 0]), [[np.tan(0.1), 0]] * 5, atol=1e-12
    )


@pytest.mark.parametrize("quarters", range(4))
def test_a_photo_turned_counter_clockwise_by_its_quarters_is_upright(quarters):
    point = [0.1, -0.05, 0.2]
    upright = seen(ring(0.4).matrices(), point)
    for (x, y), (right, down) in zip(
        seen(ring(0.4, quarters=quarters).matrices(), point), upright, strict=True
    ):
        photo = np.zeros((101, 101))
        photo[round(50 + 100 * y), round(50 + 100 * x)] = 1
        assert np.rot90(photo, quarters)[round(50 + 100 * down), round(50 + 100 * right)] == 1


def test_poses_have_the_gradient_of_finite_differences():
    start = ring(0.4, 0.1, 0.05, quarters=1)
    parts = (AZIMUTH, start.elevation, start.pan, start.roll)

    def poses(*angles: torch.Tensor) -> torch.Tensor:
        return Ring(*angles, start.quarters).poses()

    assert torch.autograd.gradcheck(poses, [part.clone().requires_grad_() for part in parts])


def test_the_order_on_a_ring_is_that_of_the_azimuths():
    shuffled = [3, 0, 4, 1, 2]
    poses = replace(ring(0.2), azimuth=AZIMUTH[shuffled]).matrices()
    assert order_on_ring(poses).tolist() == np.argsort(shuffled).tolist()
