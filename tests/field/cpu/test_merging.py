"""Intervals that give little light become one: by the definition, and in the CPU backend's kernel alike."""

import math

import numpy as np
import pytest
import torch

from biresnerf.field.cpu.marching import merge
from biresnerf.field.radiance_field import Merging
from biresnerf.field.reference import operations as reference

CLEAR, DENSE = 0.0, -math.log(0.8)  # densities that take none and a fifth of the light


def merged(density, t, jitter=0.25, light=0.1, most=3):
    """Sample, length of the intervals of one ray that are left."""
    t = torch.tensor(t)
    at, length, ray = reference.merge(
        torch.tensor(density), t, torch.ones(len(t)), torch.zeros(len(t), dtype=torch.long),
        torch.tensor([jitter]), Merging(light, most),
    )  # fmt: skip
    assert not ray.any()
    return list(zip(at.tolist(), length.tolist(), strict=True))


def test_neighbours_that_give_no_light_are_one_interval_as_long_as_there_may_be_members():
    assert merged([CLEAR] * 5, [0.5, 1.5, 2.5, 3.5, 4.5]) == [(0.75, 3.0), (3.5, 2.0)]


def test_what_gives_much_light_stays_alone_and_its_sample_in_the_middle():
    assert merged([CLEAR, DENSE, DENSE, CLEAR], [0.5, 1.5, 2.5, 3.5], light=0.15) == [
        (0.5, 1.0), (1.5, 1.0), (2.5, 1.0), (3.5, 1.0)
    ]  # fmt: skip
    assert merged([CLEAR, CLEAR, DENSE, CLEAR], [0.5, 1.5, 2.5, 3.5], light=0.25) == [(0.75, 3.0), (3.5, 1.0)]


def test_nothing_is_merged_across_a_gap():
    assert merged([CLEAR] * 4, [0.5, 1.5, 3.5, 4.5]) == [(0.5, 2.0), (3.5, 2.0)]


def test_a_ray_ends_where_hardly_any_light_is_left():
    assert merged([9.0, 1.0, CLEAR], [0.5, 1.5, 2.5], most=1) == [(0.5, 1.0), (1.5, 1.0)]


@pytest.mark.parametrize(("light", "most"), [(0.03, 8), (0.2, 3), (0.0, 8), (1.0, 1)])
def test_the_kernel_merges_as_defined(light, most):
    rng = np.random.default_rng(4)
    count = rng.integers(0, 40, 60).astype(np.int32)
    rows = [np.cumsum(rng.choice([1.0, 2.0], n, p=[0.8, 0.2])) for n in count]  # some with a gap before
    t_buffer, dt_buffer = np.zeros((60, 40), np.float32), np.ones((60, 40), np.float32)
    for buffer, row in zip(t_buffer, rows, strict=True):
        buffer[: len(row)] = row
    offset = np.concatenate([[0], np.cumsum(count)])
    density = rng.choice([0.0, 0.01, 0.1, 2.0], offset[-1], p=[0.3, 0.3, 0.3, 0.1]).astype(np.float32)
    jitter = rng.random(60).astype(np.float32)
    t, dt, ray = reference.merge(
        torch.from_numpy(density), torch.from_numpy(np.concatenate(rows)).float(), torch.ones(len(density)),
        torch.from_numpy(np.repeat(np.arange(60), count)), torch.from_numpy(jitter), Merging(light, most),
    )  # fmt: skip
    merge(density, offset, jitter, np.float32(light), most, t_buffer, dt_buffer, count)
    np.testing.assert_array_equal(count, np.bincount(ray.numpy(), minlength=60))
    left = np.arange(40) < count[:, None]
    np.testing.assert_allclose(t_buffer[left], t.numpy(), rtol=1e-6)
    np.testing.assert_allclose(dt_buffer[left], dt.numpy(), rtol=1e-6)
