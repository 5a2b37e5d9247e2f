"""Cameras that stay on a ring: a step of Adam moves what they share by a whole step."""

from __future__ import annotations

import numpy as np
import torch

from biresnerf.geometry.turntable import Ring
from biresnerf.refinement.parameters.ring_parameters import RingParameters, smoothing

COUNT, DISTANCE, RATE = 7, 3.5, 1e-3
RUN = torch.tensor([0, 0, 0, 0, 1, 1, 1])


def start() -> Ring:
    azimuth = torch.arange(COUNT) * (2 * torch.pi / COUNT)
    return Ring(azimuth, torch.tensor(0.3), torch.tensor(0.02), torch.tensor(-0.01), torch.zeros(COUNT))


def parameters() -> RingParameters:
    return RingParameters(start(), DISTANCE, RUN, torch.device("cpu"), 3.0)


def test_without_increments_cameras_are_where_the_ring_puts_them():
    poses = parameters().poses().numpy()
    expected = start().matrices()
    np.testing.assert_allclose(poses[:, :3, :3], expected[:, :3, :3], atol=1e-6)
    np.testing.assert_allclose(poses[:, :3, 3], DISTANCE * expected[:, :3, 3], atol=1e-5)


def test_a_step_of_adam_moves_shared_angles_by_the_rate_and_azimuths_with_their_neighbours_of_one_run():
    moving = parameters()
    now = moving.now()
    (3 * now.pan - 2 * now.roll - now.azimuth[0]).backward()
    moving.step(RATE)
    after = moving.now().detached()
    moved = torch.stack([after.roll + 0.01, after.pan - 0.02, after.elevation - 0.3])
    np.testing.assert_allclose(moved.numpy(), [RATE, -RATE, 0], atol=1e-6)
    turned = (after.azimuth - start().azimuth).numpy()
    np.testing.assert_allclose(turned[RUN == 0], RATE, atol=1e-6)
    np.testing.assert_allclose(turned[RUN == 1], 0, atol=1e-9)


def test_weights_of_neighbours_sum_to_one_and_fall_with_their_distance_round_the_ring():
    weights = smoothing(torch.arange(30) * (2 * torch.pi / 30), torch.zeros(30), 3.0).numpy()
    np.testing.assert_allclose(weights.sum(1), 1, rtol=1e-6)
    np.testing.assert_allclose(weights[0, 1], weights[0, 29], rtol=1e-5)
    np.testing.assert_allclose(weights[0, 3] / weights[0, 0], np.exp(-0.5), rtol=1e-5)
