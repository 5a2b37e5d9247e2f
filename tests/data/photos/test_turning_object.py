"""Photos of a turning object are recognised by their order and a static background."""

from __future__ import annotations

import tracemalloc

import numpy as np

from biresnerf.data.photos.alike.turning_object import goes_round, still_surroundings


def turning(count: int, turns: float = 1.0, seed: int = 0) -> np.ndarray:
    """Photos [count, 24, 24] of a smooth pattern that passes by, once for each turn, in the middle of grey."""
    rng = np.random.default_rng(seed)
    angle = np.linspace(0, 2 * np.pi * turns, count, endpoint=False)[:, None, None]
    column = np.linspace(-np.pi / 2, np.pi / 2, 12)
    phases = rng.uniform(0, 2 * np.pi, (12, 4))
    photos = np.full((count, 24, 24), 0.5, dtype=np.float32)
    for wave, phase in enumerate(phases.T, start=1):
        photos[:, 6:18, 6:18] += 0.1 * np.sin(wave * (column + angle) + phase[:, None])
    return photos


def test_photos_in_order_around_an_object_go_round_and_others_do_not():
    photos = turning(30)
    assert goes_round(photos)
    assert not goes_round(photos[np.random.default_rng(1).permutation(30)])
    assert not goes_round(turning(30, turns=0.6))  # the last is unlike the first
    assert not goes_round(photos[::6])  # too few to tell


def test_only_a_background_with_texture_that_stays_is_in_the_way():
    photos = turning(30)
    assert not still_surroundings(photos)  # of one colour
    behind = np.random.default_rng(2).uniform(0, 1, (24, 24)).astype(np.float32)
    before = photos.copy()
    before[:, [0, -1]], before[:, :, [0, -1]] = behind[[0, -1]], behind[:, [0, -1]]
    assert still_surroundings(before)
    moving = before + np.linspace(0, 0.4, 30, dtype=np.float32)[:, None, None]
    assert not still_surroundings(moving)


def test_a_thousand_photos_are_compared_without_an_array_of_all_their_differences():
    photos = turning(1000)
    tracemalloc.start()
    try:
        assert goes_round(photos)
        most = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert most < 100e6  # the differences take 2.3 GB
