"""Marching passes empty space in long strides and finds the live intervals that single steps find."""

import numpy as np
import pytest
import torch

from biresnerf.field.cpu.marching import BLOCK, FARTHEST, clearances, march
from biresnerf.field.reference import operations as reference

STEP, NEAR, FAR, MOST = 0.013, 0.1, 12.0, 512


def rays(count, unbounded, draws):
    """Through the middle of the scene from within or without, some of them along an axis."""
    direction = torch.randn(count, 3, generator=draws)
    direction[: count // 10, :2] = 0
    direction = torch.nn.functional.normalize(direction, dim=1)
    aim = (torch.rand(count, 3, generator=draws) - 0.5) * 1.4
    return aim - direction * (1.2 if unbounded else 3.0), direction, torch.rand(count, generator=draws)


@pytest.mark.parametrize("unbounded", [False, True])
@pytest.mark.parametrize(("side", "share"), [(16, 0.02), (64, 0.0005), (64, 0.0), (5, 0.1), (8, 1.0)])
def test_no_live_interval_is_passed_over(unbounded, side, share):
    draws, count = torch.Generator().manual_seed(3), 500
    origin, direction, jitter = rays(count, unbounded, draws)
    occupied = (torch.rand(side, side, side, generator=draws) < share).to(torch.uint8)
    middle, _, ray = reference.march(origin, direction, jitter, occupied, STEP, NEAR, FAR, unbounded, MOST)
    middles, length = np.zeros((2, count, MOST), np.float32)
    found = np.zeros(count, np.int32)
    march(
        origin.numpy(), direction.numpy(), jitter.numpy(), occupied.numpy().reshape(-1), side,
        clearances(occupied.numpy()), np.float32(STEP), np.float32(NEAR), np.float32(FAR), unbounded,
        middles, length, found,
    )  # fmt: skip
    expected = torch.bincount(ray, minlength=count).numpy()
    same = expected == found  # a midpoint on a cell face may fall to either side
    assert same.mean() > 0.99
    assert abs(expected - found).max() <= 1
    middles = middles[(np.arange(MOST) < found[:, None]) & same[:, None]]
    np.testing.assert_allclose(middles, middle.numpy()[same[ray.numpy()]], atol=1e-3 if unbounded else 1e-5)


def test_clearances_are_distances_to_the_nearest_block_with_anything_in_it():
    side = 12 * BLOCK
    occupied = np.zeros((side, side, side), np.uint8)
    cells = np.random.default_rng(0).integers(0, side, (3, 3))
    occupied[tuple(cells.T)] = 1
    block = np.stack(np.meshgrid(*3 * [np.arange(12)], indexing="ij"), -1)
    away = abs(block[..., None, :] - cells // BLOCK).max(-1).min(-1)
    np.testing.assert_array_equal(clearances(occupied), np.minimum(away, FARTHEST))
