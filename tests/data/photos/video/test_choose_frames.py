"""The frames that are chosen are sharp, and spread over the camera's path."""

from __future__ import annotations

import numpy as np
import pytest

from biresnerf.data.photos.video.choose_frames import SIDE, FrameWatch, choose_frames
from tests.data.photos.video.filmed import HEIGHT, wall


def seen(at_px: list[tuple[float, float]]) -> FrameWatch:
    """A watch that looked at the wall from these places, x and y in px."""
    scene, watch = np.asarray(wall(900).convert("L")), FrameWatch()
    for x, y in at_px:
        watch.look(scene[int(y) : int(y) + HEIGHT - 40, int(x) : int(x) + SIDE])
    return watch


@pytest.mark.parametrize("step", [1, 3, 12, 30])
def test_the_way_of_the_picture_is_measured_however_fast_it_moves(step):
    places = [(step * i, 0) for i in range(1 + 360 // step)]
    travelled = seen(places).travelled
    # Frames are compared at half their size.
    assert travelled[-1] == pytest.approx(places[-1][0] / 2, rel=0.1, abs=1.5)
    assert (np.diff(travelled) >= -1).all()


def test_a_camera_that_goes_back_and_forth_travels_on():
    there = [(6 * i, 0) for i in range(60)]
    # Where it turns, the way to and from the frame compared with is lost.
    assert seen(there + there[::-1]).travelled[-1] == pytest.approx(2 * 6 * 59 / 2, abs=2 * 12)


def test_the_sharpest_of_each_stretch_is_taken_and_a_pause_adds_none():
    way = np.concatenate([np.linspace(0, 500, 100), np.full(300, 500.0), np.linspace(500, 1000, 100)])
    sharpness = np.where(np.arange(500) % 7 == 3, 10.0, 1.0)
    chosen = choose_frames(np.arange(500) / 30, sharpness, way, 20)
    assert len(chosen) == 20
    assert (sharpness[chosen] == 10).mean() >= 0.9
    gaps = np.diff(way[chosen])
    assert gaps.max() <= 2 * 1000 / 20
    assert sum(105 < index < 395 for index in chosen) <= 1


def test_of_a_camera_that_stands_still_frames_are_spread_over_time():
    chosen = choose_frames(np.arange(300) / 30, np.ones(300), np.zeros(300), 10)
    assert np.diff(chosen).min() >= 15
    assert len(chosen) == 10


@pytest.mark.parametrize(("frames", "count"), [(1, 5), (4, 5), (5, 5), (6, 5)])
def test_no_frame_is_taken_twice_where_there_are_few(frames, count):
    chosen = choose_frames(np.arange(frames) / 30, np.ones(frames), np.arange(frames) * 9.0, count)
    assert chosen == sorted(set(chosen))
    assert len(chosen) <= min(frames, count)
    assert len(chosen) >= min(frames, count) - 1
