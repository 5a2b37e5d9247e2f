"""The order of photos around an object: as named, or assembled from sequences, some reversed or taken sideways."""

from __future__ import annotations

from functools import cache

import numpy as np
import torch

from biresnerf.data.synthetic.scene import CAMERA_DISTANCE, SHAPES, random_textures, render_shapes
from biresnerf.geometry.turntable import Ring
from biresnerf.refinement.start.ring_order import axis_in_photos, find_ring
from tests.refinement.tiny_scene import photos_set

COUNT, SIZE, FOCAL = 36, 24, 40.0


@cache
def around(pan: float = 0.0) -> list[np.ndarray]:
    """Photos of the synthetic scene on black, a whole turn of it."""
    azimuth = torch.arange(COUNT) * (2 * torch.pi / COUNT)
    ring = Ring(azimuth, torch.tensor(0.35), torch.tensor(pan), torch.tensor(0.0), torch.zeros(COUNT))
    poses = ring.matrices()
    poses[:, :3, 3] *= CAMERA_DISTANCE
    textures = random_textures(len(SHAPES), 1)
    seen = [render_shapes(SHAPES, textures, pose, SIZE, SIZE, FOCAL)[0].astype(np.uint16) for pose in poses]
    return [(rgba[..., :3] * rgba[..., 3:] // 255).astype(np.uint8) for rgba in seen]


def same_ring(order: np.ndarray, expected: np.ndarray) -> bool:
    """Whether both go round the same ring, from any photo on and either way."""
    follows = {frozenset(pair) for pair in zip(order, np.roll(order, 1), strict=True)}
    return follows == {frozenset(pair) for pair in zip(expected, np.roll(expected, 1), strict=True)}


def test_photos_named_in_order_stay_as_they_are_named():
    ring = find_ring(photos_set(around()), np.arange(COUNT))
    assert not ring.run.any()
    assert ring.order.tolist() == list(range(COUNT))
    assert not ring.quarters.any()


def test_runs_that_start_anywhere_and_go_either_way_are_put_together():
    taken = np.concatenate([np.arange(30, 36), np.arange(20, 8, -1), np.arange(0, 9), np.arange(21, 30)])
    ring = find_ring(photos_set([around()[i] for i in taken]), np.arange(COUNT))
    assert set(ring.run) == {0, 1, 2, 3}
    assert same_ring(taken[ring.order], np.arange(COUNT))
    assert not ring.quarters.any()
    assert all(len(set(ring.run[part])) == 1 for part in np.split(np.arange(COUNT), [6, 18, 27]))


def test_a_run_taken_with_the_camera_on_its_side_is_turned_back():
    photos = around()
    taken = [*photos[24:], *(np.rot90(photo, -1) for photo in photos[:24])]
    ring = find_ring(photos_set([np.ascontiguousarray(photo) for photo in taken]), np.arange(COUNT))
    assert set(ring.run) == {0, 1}
    assert same_ring(np.r_[24:36, 0:24][ring.order], np.arange(COUNT))
    assert ring.quarters.tolist() == [0] * 12 + [1] * 24


def test_quarter_turns_add_up_from_run_to_run():
    taken = [np.rot90(photo, -(index // 12)) for index, photo in enumerate(around())]
    ring = find_ring(photos_set([np.ascontiguousarray(photo) for photo in taken]), np.arange(COUNT))
    first = ring.quarters[ring.order[0]]
    assert [(int(q) - first) % 4 for q in ring.quarters] == [
        (i // 12 - ring.order[0] // 12) % 4 for i in range(COUNT)
    ]


def test_the_axis_is_where_the_mean_photo_is_symmetric_also_in_photos_on_their_side():
    right = FOCAL * np.tan(0.08) / SIZE
    for photos, expected in ((around(), (0, 0.0)), (around(0.08), (0, right))):
        images = photos_set(photos)
        quarter, place = axis_in_photos(images, find_ring(images, np.arange(COUNT)))
        assert quarter == expected[0]
        assert abs(place - expected[1]) < 1 / SIZE
    lying = photos_set([np.ascontiguousarray(np.rot90(photo, -1)) for photo in around()])
    assert axis_in_photos(lying, find_ring(lying, np.arange(COUNT)))[0] == 1
