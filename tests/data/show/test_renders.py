"""Pictures for people read back with the intended content."""

from __future__ import annotations

import imageio.v2 as imageio
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from biresnerf.data.show.renders import depth_picture, picture_stems, ramp_colours, write_orbit, write_view


def read(path) -> np.ndarray:
    return np.asarray(Image.open(path))


def test_a_view_is_four_pictures_of_one_size(tmp_path):
    rng = np.random.default_rng(0)
    render, photo = rng.uniform(0, 1, (12, 18, 3)), rng.integers(0, 256, (12, 18, 3), dtype=np.uint8)
    paths = write_view(
        tmp_path / "renders", "a", render=render, photo=photo, depth=rng.uniform(1, 2, (12, 18))
    )
    assert [p.name for p in paths] == ["a_render.png", "a_photo.png", "a_difference.png", "a_depth.png"]
    np.testing.assert_allclose(read(paths[0]), 255 * render, atol=0.51)
    assert np.array_equal(read(paths[1]), photo)
    assert all(read(path).shape == (12, 18, 3) for path in paths)


def test_equal_pictures_have_no_difference_and_more_difference_is_brighter(tmp_path):
    photo = np.zeros((2, 4, 3))
    render = photo + np.array([0.0, 0.05, 0.2, 0.9])[None, :, None]
    row = read(write_view(tmp_path, "a", render=render, photo=photo)[2])[0].astype(int)
    assert row[0].tolist() == [68, 1, 84]
    assert row[3].tolist() == [253, 231, 37]
    brightness = row @ [0.2126, 0.7152, 0.0722]
    assert (np.diff(brightness) > 10).all()


def test_near_is_bright_far_is_dark_and_nothing_is_black():
    depth = np.array([[1.0, 2.0, 3.0, np.inf, np.nan, 0.0]])
    picture = depth_picture(depth)[0]
    assert picture[0].tolist() == [253, 231, 37]
    assert picture[2].tolist() == [68, 1, 84]
    assert (picture[3:] == 0).all()
    assert (depth_picture(np.full((2, 2), np.inf)) == 0).all()
    assert depth_picture(np.ones((2, 2))).shape == (2, 2, 3)


def test_the_ramp_grows_in_brightness_everywhere():
    brightness = ramp_colours(np.linspace(0, 1, 100)).astype(float) @ [0.2126, 0.7152, 0.0722]
    assert (np.diff(brightness) > -0.5).all()
    assert np.array_equal(ramp_colours(np.array([-3.0, 7.0])), ramp_colours(np.array([0.0, 1.0])))


def test_pictures_of_other_sizes_or_with_nan_are_refused(tmp_path):
    good = np.zeros((4, 4, 3))
    with pytest.raises(ValueError, match="one size"):
        write_view(tmp_path, "a", render=good, photo=np.zeros((4, 5, 3)))
    with pytest.raises(ValueError, match="NaN"):
        write_view(tmp_path, "a", render=np.full_like(good, np.nan), photo=good)
    with pytest.raises(ValueError, match="h, w, 3"):
        write_view(tmp_path, "a", render=np.zeros((4, 4)), photo=good)
    assert list(tmp_path.iterdir()) == []


@given(st.lists(st.text(max_size=12), max_size=8))
def test_stems_are_unique_plain_file_names(names):
    stems = picture_stems(names)
    assert len({stem.casefold() for stem in stems}) == len(names)
    assert all(stem and not set(stem) & set('/\\:*?"<>|\0') for stem in stems)


def test_stems_keep_what_tells_images_apart():
    names = ["./train/r_0", "images/a.b.JPG", "images/a.b.png", "../x/7.jpeg"]
    assert picture_stems(names) == ["train_r_0", "images_a.b", "images_a.b_2", "x_7"]


@pytest.mark.parametrize("size", [(30, 40), (31, 41)])
def test_the_orbit_video_holds_every_frame_at_even_size(tmp_path, size):
    height, width = size
    y, x = np.mgrid[:height, :width]
    frames = [np.stack([x / width, y / height, np.full(size, i / 12)], axis=-1) for i in range(12)]
    assert write_orbit(tmp_path / "orbit.mp4", iter(frames)) == 12
    with imageio.get_reader(tmp_path / "orbit.mp4", format="FFMPEG") as reader:
        assert reader.get_meta_data()["codec"] == "h264"
        shown = [np.asarray(frame) for frame in reader]
    assert len(shown) == 12
    assert shown[0].shape == (height + height % 2, width + width % 2, 3)
    for frame, given_ in zip(shown, frames, strict=True):
        assert np.abs(frame[:height, :width] / 255.0 - given_).mean() < 0.03
    assert [p.name for p in tmp_path.iterdir()] == ["orbit.mp4"]


def test_an_orbit_without_frames_or_with_uneven_ones_leaves_no_file(tmp_path):
    with pytest.raises(ValueError, match="at least one"):
        write_orbit(tmp_path / "orbit.mp4", [])
    with pytest.raises(ValueError, match="those before"):
        write_orbit(tmp_path / "orbit.mp4", [np.zeros((4, 4, 3)), np.zeros((6, 4, 3))])
    assert list(tmp_path.iterdir()) == []
